"""Random materials for training, with natural, nearly plain or periodic textures; some are glossy."""

import colorsys

import numpy as np

from stereoweave.synth.world import Colour, Material

# Fractions of the kinds of texture. Training on natural image statistics transfers to photographs; real rooms
# are hard because of their plain and periodic surfaces.
_PHOTOGRAPHS, _PLAIN, _PERIODIC = 0.35, 0.20, 0.12
# Fraction of plain surfaces among walls, floors and tables. In the middle of such a surface, the nearest
# texture is outside a matcher's receptive field.
_BROAD_PLAIN = 0.65
PERIODIC = ("brick", "tiles", "cloth")
NATURAL = (
    ("rust", "paint", "steel", "concrete", "plaster", "stone", "bark", "wood")
    + ("leaves", "grass", "soil", "gravel", "asphalt", "water", "sky", "sign")
)  # fmt: skip
_TYPICAL_FOCAL_PX = 600


def draw_material(rng: np.random.Generator, distance_m: float) -> Material:
    """Draw a random material of any kind, with texels about the size of a pixel when seen from distance_m."""
    family = _draw_family(rng)
    glossy = rng.random() < 0.2
    return Material(
        texture=family,
        variant=int(rng.integers(1000)),
        tint=draw_muted_colour(rng, 0.45) if family == "plain" else draw_natural_tint(rng),
        span_m=draw_fine_span_m(rng, distance_m),
        roughness=rng.uniform(0.1, 0.4) if glossy else rng.uniform(0.5, 1.0),
        metal=float(glossy and rng.random() < 0.35),
        relief=rng.uniform(0.0, 0.6),
    )


def draw_material_from(rng: np.random.Generator, families: tuple[str, ...], distance_m: float) -> Material:
    """Draw a random matt material with a texture from one of the families.

    Its texels are about the size of a pixel when seen from distance_m.
    """
    family = families[rng.integers(len(families))]
    return Material(
        texture=family,
        variant=int(rng.integers(1000)),
        tint=draw_muted_colour(rng, 0.25)
        if family in ("plain", "paint", "plaster")
        else draw_natural_tint(rng),
        span_m=draw_fine_span_m(rng, distance_m),
        roughness=rng.uniform(0.5, 1.0),
        relief=rng.uniform(0.1, 0.5),
    )


def draw_broad_material(rng: np.random.Generator, families: tuple[str, ...], distance_m: float) -> Material:
    """Draw a random, usually plain material for a wall, floor or table."""
    if rng.random() >= _BROAD_PLAIN:
        return draw_material_from(rng, families, distance_m)
    return Material(
        texture="plain",
        variant=int(rng.integers(1000)),
        tint=draw_muted_colour(rng, 0.3),
        # Enlarging the texture up to six times leaves little local contrast.
        span_m=draw_fine_span_m(rng, distance_m) * rng.uniform(1, 6),
        roughness=rng.uniform(0.35, 1.0),
        relief=rng.uniform(0.0, 0.1),
    )


def draw_fine_span_m(rng: np.random.Generator, distance_m: float) -> float:
    """Draw a random span for a texture, in metres.

    Seen from distance_m, a texture of this span has 0.6 to 3 texels per pixel along each axis.
    """
    across_px = np.exp(rng.uniform(np.log(170), np.log(800)))
    return float(distance_m * across_px / _TYPICAL_FOCAL_PX)


def draw_muted_colour(rng: np.random.Generator, saturation: float) -> Colour:
    """Draw a random greyish colour for walls and objects, from dark to almost white."""
    hue = rng.choice([rng.uniform(0.02, 0.16), rng.uniform()], p=[0.6, 0.4])
    red, green, blue = colorsys.hsv_to_rgb(hue, rng.uniform(0, saturation), rng.uniform(0.15, 0.9))
    return red, green, blue


def draw_natural_tint(rng: np.random.Generator) -> Colour:
    """Draw a random tint that changes the brightness of a texture but hardly its colour."""
    red, green, blue = rng.uniform(0.55, 1.0) * rng.uniform(0.88, 1.0, 3)
    return float(red), float(green), float(blue)


def _draw_family(rng: np.random.Generator) -> str:
    kind = rng.random()
    if kind < _PHOTOGRAPHS:
        return "photograph"
    if kind < _PHOTOGRAPHS + _PLAIN:
        return "plain"
    families = PERIODIC if kind < _PHOTOGRAPHS + _PLAIN + _PERIODIC else NATURAL
    return str(rng.choice(families))
