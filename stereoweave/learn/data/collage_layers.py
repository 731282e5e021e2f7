"""Random surfaces and paints for the layers of a collage."""

import cv2
import numpy as np
from jaxtyping import Float

from stereoweave.learn.data.collage_scene import CollageLayer, CollageSurface
from stereoweave.learn.data.paint_kernels import Paint
from stereoweave.learn.data.silhouettes import Patch, Placement
from stereoweave.learn.data.textures import (
    LIGHT_MAPS,
    NATURAL_TEXTURES,
    PERIODIC_TEXTURES,
    SIDE,
    draw_natural_colour,
    make_light_map,
    make_natural,
    make_periodic,
)

PLANE_SLOPE = 0.3  # px of disparity per px: steeper surfaces are rare and nearly edge-on to one camera
BEND_SLOPE = 0.25  # bends add to the plane; the sum stays below 0.6, so that every surface faces both cameras
RELIEF = 0.3  # approximate largest variation of a surface, as a share of the scene's largest disparity


def draw_layer(
    rng: np.random.Generator, patch: Patch, place: Placement, level_px: float, limit_px: float
) -> CollageLayer:
    """Draw a layer with a random surface and a random paint."""
    return CollageLayer(
        patch=patch,
        surface=draw_surface(rng, place, level_px, limit_px),
        paint=draw_paint(rng, place),
    )


def draw_plane(
    rng: np.random.Generator, place: Placement, level_px: float, limit_px: float
) -> CollageSurface:
    """Draw a plane with disparity `level_px` at its centre; one plane in five faces the camera."""
    slope = min(PLANE_SLOPE, RELIEF * limit_px / place.radius_px)
    flat = rng.random() < 0.2
    slope_x, slope_y = (0.0, 0.0) if flat else (slope * rng.triangular(-1, 0, 1, 2)).tolist()
    return CollageSurface(plane=(level_px, slope_x, slope_y, place.x, place.y), limit_px=limit_px)


def draw_surface(
    rng: np.random.Generator, place: Placement, level_px: float, limit_px: float
) -> CollageSurface:
    """Draw a surface that is planar in half of the layers and bent in the others."""
    plane = draw_plane(rng, place, level_px, limit_px).plane
    relief_px = RELIEF * limit_px
    waves, hills = [], []
    bend = rng.random()
    if bend < 0.25:
        for _ in range(rng.integers(1, 4)):
            frequency = 2 * np.pi / (place.radius_px * rng.uniform(0.5, 3) + 16)
            turn = rng.uniform(0, np.pi)
            amplitude = min(BEND_SLOPE / 3 / frequency, relief_px / 3) * rng.random()
            along_x, along_y = frequency * np.cos(turn), frequency * np.sin(turn)
            waves.append((amplitude, along_x, along_y, rng.uniform(0, 2 * np.pi)))
    elif bend < 0.5:
        radius_px = place.radius_px * rng.uniform(0.4, 1.2)
        # The steepest slope of a Gaussian is 0.86 times its height divided by its radius.
        height_px = min(BEND_SLOPE * radius_px / 0.86, relief_px) * rng.uniform(-0.4, 1)
        keep = [(1, 1), (1, 0), (0, 1)][rng.integers(3)]
        hills.append((height_px, place.x, place.y, keep[0] / radius_px, keep[1] / radius_px))
    return CollageSurface(plane=plane, waves=tuple(waves), hills=tuple(hills), limit_px=limit_px)


def draw_paint(rng: np.random.Generator, place: Placement) -> Paint:
    """Draw a lit texture of a random kind and colour; in a fifth of the layers it has almost no contrast."""
    texture, count = (
        (make_periodic, PERIODIC_TEXTURES) if rng.random() < 0.12 else (make_natural, NATURAL_TEXTURES)
    )
    texels_per_px = rng.uniform(0.45, 1.0)
    texels_per_light_px = 64 / (2 * place.radius_px + 40) * rng.uniform(0.3, 1.5)
    return Paint(
        texture=texture(int(rng.integers(count))),
        to_texture=_draw_mapping(rng, texels_per_px, SIDE),
        to_colour=_draw_recolouring(rng),
        light=make_light_map(int(rng.integers(LIGHT_MAPS))),
        to_light=_draw_mapping(rng, min(texels_per_light_px, 0.6), 64),
        gloss=_draw_gloss(rng, place),
    )


def draw_plain_paint(
    rng: np.random.Generator, place: Placement, colour: Float[np.ndarray, "3"] | None = None
) -> Paint:
    """Draw a nearly plain paint: one colour, at most 3 % of a texture's contrast, and almost even light."""
    paint = draw_paint(rng, place)
    contrast = rng.uniform(0, 0.03) if rng.random() < 0.7 else 0.0
    light = 1 + rng.uniform(0, 0.35) * (paint.light - 1)
    to_colour = _reduce_contrast(contrast, draw_natural_colour(rng) if colour is None else colour)
    return paint._replace(to_colour=to_colour, light=light.astype(np.float32))


def draw_unfocused_paint(rng: np.random.Generator, place: Placement) -> Paint:
    """Draw an out-of-focus texture, without detail finer than 8 to 32 px."""
    paint = draw_paint(rng, place)
    texels, side = int(SIDE / rng.uniform(8, 32)), SIDE // 2
    small = cv2.resize(paint.texture, (texels, texels), interpolation=cv2.INTER_AREA)
    smooth = cv2.resize(small, (side, side), interpolation=cv2.INTER_CUBIC)
    return paint._replace(texture=smooth, to_texture=_draw_mapping(rng, 0.5, side))


def _draw_mapping(rng: np.random.Generator, texels_per_px: float, side: int) -> Float[np.ndarray, "2 3"]:
    # In photographs, most vertical structures appear vertical.
    turn = rng.normal(0, 0.1) if rng.random() < 0.5 else rng.uniform(0, 2 * np.pi)
    cosine, sine = texels_per_px * np.cos(turn), texels_per_px * np.sin(turn)
    shift = rng.uniform(0, 2 * side, 2)
    return np.array([[cosine, -sine, shift[0]], [sine, cosine, shift[1]]], np.float32)


def _draw_recolouring(rng: np.random.Generator) -> Float[np.ndarray, "3 4"]:
    """Draw a colour transform that removes most of the contrast in a fifth of the layers."""
    if rng.random() < 0.2:
        return _reduce_contrast(rng.uniform(0.01, 0.08), draw_natural_colour(rng))
    gain = np.exp(rng.normal(0, 0.25) + rng.normal(0, 0.1, 3))
    mix = np.eye(3) * gain
    if rng.random() < 0.1:
        mix = mix[rng.permutation(3)]
    lift = rng.normal(0, 10)
    return np.column_stack([mix, np.full(3, lift)]).astype(np.float32)


def _reduce_contrast(contrast: float, colour: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 4"]:
    return np.column_stack([contrast * np.eye(3), colour - contrast * 110]).astype(np.float32)


def _draw_gloss(rng: np.random.Generator, place: Placement) -> Float[np.ndarray, "6"]:
    """Draw a highlight on a fifth of the layers, shifted on the surface by up to 8 px in the right view."""
    if rng.random() < 0.8:
        return np.zeros(6, np.float32)
    x, y = rng.normal([place.x, place.y], place.radius_px / 2)
    inverse = 1 / (place.radius_px * rng.uniform(0.1, 0.5, 2) + 3)
    return np.array([x, y, inverse[0], inverse[1], rng.uniform(30, 160), rng.uniform(-8, 8)], np.float32)
