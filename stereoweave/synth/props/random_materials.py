"""Random materials for training: natural, nearly plain or periodic textures, a fifth of them glossy."""

import colorsys

import numpy as np

from stereoweave.synth.world import Colour, Material

# Natural image statistics transfer to photographs; plain and periodic surfaces make real rooms hard.
_PHOTOGRAPHS, _PLAIN, _PERIODIC = 0.35, 0.20, 0.12
# Share of plain walls, floors and tables, whose middle is farther from any texture than a matcher sees.
_BROAD_PLAIN = 0.65
PERIODIC = ("brick", "tiles", "cloth")
NATURAL = (
    ("rust", "paint", "steel", "concrete", "plaster", "stone", "bark", "wood")
    + ("leaves", "grass", "soil", "gravel", "asphalt", "water", "sky", "sign")
)  # fmt: skip
_TYPICAL_FOCAL_PX = 600


def draw_material(rng: np.random.Generator, distance_m: float) -> Material:
    """Draw any material, its texels as fine as pixels seen from distance_m."""
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
    """Draw a dull material of one of the families, its texels as fine as pixels seen from distance_m."""
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
    """Draw a material for a wall, floor or table: mostly plain, otherwise of one of the families."""
    if rng.random() >= _BROAD_PLAIN:
        return draw_material_from(rng, families, distance_m)
    return Material(
        texture="plain",
        variant=int(rng.integers(1000)),
        tint=draw_muted_colour(rng, 0.3),
        # Up to six times coarser than pixels, so that little of the texture's contrast remains.
        span_m=draw_fine_span_m(rng, distance_m) * rng.uniform(1, 6),
        roughness=rng.uniform(0.35, 1.0),
        relief=rng.uniform(0.0, 0.1),
    )


def draw_fine_span_m(rng: np.random.Generator, distance_m: float) -> float:
    """Draw a texture's span in metres such that 1 to 3 of its 512 texels, at times fewer, fall on a pixel."""
    across_px = np.exp(rng.uniform(np.log(170), np.log(800)))
    return float(distance_m * across_px / _TYPICAL_FOCAL_PX)


def draw_muted_colour(rng: np.random.Generator, saturation: float) -> Colour:
    """Draw a greyish colour of walls and objects, from dark to almost white."""
    hue = rng.choice([rng.uniform(0.02, 0.16), rng.uniform()], p=[0.6, 0.4])
    red, green, blue = colorsys.hsv_to_rgb(hue, rng.uniform(0, saturation), rng.uniform(0.15, 0.9))
    return red, green, blue


def draw_natural_tint(rng: np.random.Generator) -> Colour:
    """Draw a tint that changes brightness but hardly the colour."""
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
