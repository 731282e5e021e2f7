"""Endless training pairs: layers of paper-thin, slanted and bent surfaces, painted into both views.

What transfers to photographs is natural textures and a wide spread of disparities rather than exact
geometry, so a scene is a collage; its disparity is exact in both views all the same.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from stereoweave.learn.paint import Paint, Sheet, colour, cover, expose, occlusion, seen_from_right, surface
from stereoweave.learn.shapes import Patch, Place, below, draw_shape, everywhere, rods
from stereoweave.stereo import Sample
from stereoweave.synth.patterns import SIDE, Bank, bank, natural_colour

PLANE_SLOPE = 0.3  # px of disparity a px: steeper surfaces are rare and nearly edge-on to one camera
BEND_SLOPE = 0.25  # bends add to the plane; together below 0.6, so that no surface turns its back
RELIEF = 0.3  # of the scene's greatest disparity: about how much one surface varies at most
NETWORK_REACH_PX = 188  # no network finds a greater disparity
CLEAN_SHARE = 0.25  # pairs without any photometric difference
LEVELS = np.arange(1021, dtype=np.float32) / 4  # grey levels that a tone curve tells apart


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Disparity over left-image x, y: a sum of products of a function of x and one of y, within 0..limit_px.

    Attributes:
        plane: disparity at the centre, its slopes along x and y, the centre's x and y.
        waves: rows of amplitude_px, angular frequencies along x and y, phase.
        hills: rows of height_px, centre x and y, inverse radii along x and y (0: a ridge, as on a cylinder).
        limit_px: the greatest disparity of the scene.
    """

    plane: tuple[float, float, float, float, float]
    waves: tuple[tuple[float, float, float, float], ...]
    hills: tuple[tuple[float, float, float, float, float], ...]
    limit_px: float

    def over(self, patch: Patch) -> Float[np.ndarray, "h w"]:
        """Disparity float32 at each pixel of the patch."""
        x = np.arange(patch.field.shape[1], dtype=np.float32) + patch.left
        y = np.arange(patch.field.shape[0], dtype=np.float32) + patch.top
        level, slope_x, slope_y, centre_x, centre_y = self.plane
        columns = [level + slope_x * (x - centre_x), np.ones_like(x)]
        rows = [np.ones_like(y), slope_y * (y - centre_y)]
        for amplitude, along_x, along_y, phase in self.waves:
            columns += [amplitude * np.sin(along_x * x + phase), amplitude * np.cos(along_x * x + phase)]
            rows += [np.cos(along_y * y), np.sin(along_y * y)]
        for height, middle_x, middle_y, inverse_x, inverse_y in self.hills:
            columns.append(height * np.exp(-(((x - middle_x) * inverse_x) ** 2)))
            rows.append(np.exp(-(((y - middle_y) * inverse_y) ** 2)))
        return surface(np.stack(columns).astype(np.float32), np.stack(rows).astype(np.float32), self.limit_px)


@dataclass(frozen=True, kw_only=True)
class Layer:
    """A surface within a silhouette, painted."""

    patch: Patch
    surface: Surface
    paint: Paint

    def sheet(self) -> Sheet:
        """The layer as the left camera sees it."""
        return Sheet(self.patch.field, self.surface.over(self.patch), self.patch.left, self.patch.top)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Layers from far to near (by their centres), and the size of the views in px."""

    layers: tuple[Layer, ...]
    height: int
    width: int


@dataclass(frozen=True, kw_only=True)
class Painting:
    """One view: image float32 [H, W, 3] in 0..255, and the disparity of what is seen, float32 [H, W]."""

    image: Float[np.ndarray, "h w 3"]
    disparity_px: Float[np.ndarray, "h w"]


def sample(seed: int, epoch: int, index: int, height: int = 256, width: int = 384) -> Sample:
    """Training pair number `index` of an epoch, with exact disparity and occlusion for both views.

    The same arguments give the same pair in every process. Disparities are finite and >= 0. The textures
    are built at the first call, which takes some seconds.
    """
    rng = np.random.default_rng((seed, epoch, index))
    while True:
        left, right = paint_scene(draw_scene(rng, height, width))
        occluded = occlusion(left.disparity_px, right.disparity_px, -1)
        right_occluded = occlusion(right.disparity_px, left.disparity_px, 1)
        # A pair that shows nothing to match is drawn anew.
        if occluded.mean() < 0.6 and right_occluded.mean() < 0.6 and left.image.std() > 6:
            break
    left_image, right_image = photograph(rng, left.image, right.image)
    return Sample(
        left=left_image,
        right=right_image,
        disparity_px=left.disparity_px,
        right_disparity_px=right.disparity_px,
        occluded=occluded,
        right_occluded=right_occluded,
    )


def paint_scene(scene: Scene) -> tuple[Painting, Painting]:
    """Both views of a scene, left and right, as ideal cameras see it."""
    left_sheets = [layer.sheet() for layer in scene.layers]
    right_sheets = [seen_from_right(sheet, scene.width) for sheet in left_sheets]
    return _paint_view(scene, left_sheets, 0), _paint_view(scene, right_sheets, 1)


def _paint_view(scene: Scene, sheets: list[Sheet], side: int) -> Painting:
    nearest = np.full((scene.height, scene.width), -1, np.float32)
    nearest_opaque = nearest.copy()
    image = np.full((scene.height, scene.width, 3), 0, np.float32)
    for sheet in sheets:
        cover(sheet, nearest, nearest_opaque)
    for layer, sheet in zip(scene.layers, sheets, strict=True):
        colour(image, sheet, layer.paint, nearest_opaque, side)
    return Painting(image=image, disparity_px=nearest)


def draw_scene(rng: np.random.Generator, height: int, width: int) -> Scene:
    """A scene's description: one or two backgrounds, objects, and in half of the scenes bunches of rods."""
    limit_px = _draw_limit(rng, width)
    # Left-image columns that only the right camera sees continue the canvas to the right.
    canvas_width = width + int(np.ceil(limit_px)) + 2
    far_px = rng.uniform(0, 1) if rng.random() < 0.1 else limit_px * rng.uniform(0.08, 0.5)
    layers = _draw_backgrounds(rng, far_px, limit_px, canvas_width, height)
    bunches = int(rng.integers(1, 5)) if rng.random() < 0.5 else 0
    for k in range(rng.integers(6, 25)):
        thin = k < bunches
        place = _draw_place(rng, 0.07 if thin else 0.012, canvas_width, height)
        # Large things stand behind and rods in front more often than not, so that both leave much to see.
        nearness = rng.random() ** (0.8 if thin else 1 + 3 * place.radius_px / width)
        patch = rods(rng, place) if thin else draw_shape(rng, place)
        level_px = far_px + (limit_px - far_px) * nearness
        layers.append(_draw_layer(rng, patch, place, level_px, limit_px))
    # Far to near, so that the nearer of two soft edges is blended last.
    layers.sort(key=lambda layer: layer.surface.plane[0])
    return Scene(layers=tuple(layers), height=height, width=width)


def _draw_limit(rng: np.random.Generator, width: int) -> float:
    """The scene's greatest disparity: log-uniform, mostly 10 to 110 px at 384 columns, at times 6 to 188."""
    low, high = (10, 110) if rng.random() < 0.7 else (6, NETWORK_REACH_PX)
    # Wider views show more of a scene, not larger disparities: the network has an end.
    return float(np.exp(rng.uniform(np.log(low), np.log(high)))) * min(width / 384, 1)


def _draw_place(rng: np.random.Generator, smallest: float, width: int, height: int) -> Place:
    radius_px = width * float(np.exp(rng.uniform(np.log(smallest), np.log(0.6))))
    return Place(rng.uniform(0, width), rng.uniform(0, height), radius_px, width, height)


def _draw_backgrounds(
    rng: np.random.Generator, far_px: float, limit_px: float, width: int, height: int
) -> list[Layer]:
    middle = Place(width / 2, height / 2, width / 2, width, height)
    layers = [_draw_layer(rng, everywhere(width, height), middle, far_px, limit_px)]
    if rng.random() < 0.5:
        horizon, tilt = rng.uniform(0.3, 0.8) * height, rng.normal(0, 0.1)
        # Its disparity starts at the wall's along the whole line where the two meet.
        rise = min(rng.uniform(0.3, 1.0) * (limit_px - far_px) / (height - horizon), PLANE_SLOPE)
        plane = (far_px, -tilt * rise, rise, middle.x, horizon)
        floor = Surface(plane=plane, waves=(), hills=(), limit_px=limit_px)
        patch, paint = below(horizon - tilt * middle.x, tilt, width, height), _draw_paint(rng, bank(), middle)
        layers.append(Layer(patch=patch, surface=floor, paint=paint))
    return layers


def _draw_layer(
    rng: np.random.Generator, patch: Patch, place: Place, level_px: float, limit_px: float
) -> Layer:
    return Layer(
        patch=patch,
        surface=_draw_surface(rng, place, level_px, limit_px),
        paint=_draw_paint(rng, bank(), place),
    )


def _draw_surface(rng: np.random.Generator, place: Place, level_px: float, limit_px: float) -> Surface:
    """A plane, in half of the layers bent."""
    relief_px = RELIEF * limit_px
    slope = min(PLANE_SLOPE, relief_px / place.radius_px)
    flat = rng.random() < 0.2
    slope_x, slope_y = (0.0, 0.0) if flat else (slope * rng.triangular(-1, 0, 1, 2)).tolist()
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
        # The steepest slope of a Gaussian of this radius is 0.86 of its height over the radius.
        height_px = min(BEND_SLOPE * radius_px / 0.86, relief_px) * rng.uniform(-0.4, 1)
        keep = [(1, 1), (1, 0), (0, 1)][rng.integers(3)]
        hills.append((height_px, place.x, place.y, keep[0] / radius_px, keep[1] / radius_px))
    plane = (level_px, slope_x, slope_y, place.x, place.y)
    return Surface(plane=plane, waves=tuple(waves), hills=tuple(hills), limit_px=limit_px)


def _draw_paint(rng: np.random.Generator, textures: Bank, place: Place) -> Paint:
    family = textures.periodic if rng.random() < 0.12 else textures.natural
    texels_per_px = rng.uniform(0.45, 1.0)
    texels_per_light_px = 64 / (2 * place.radius_px + 40) * rng.uniform(0.3, 1.5)
    return Paint(
        texture=family[rng.integers(len(family))],
        to_texture=_draw_mapping(rng, texels_per_px, SIDE),
        to_colour=_draw_recolouring(rng),
        light=textures.lights[rng.integers(len(textures.lights))],
        to_light=_draw_mapping(rng, min(texels_per_light_px, 0.6), 64),
        gloss=_draw_gloss(rng, place),
    )


def _draw_mapping(rng: np.random.Generator, texels_per_px: float, side: int) -> Float[np.ndarray, "2 3"]:
    # Photographs keep their uprights more often than not.
    turn = rng.normal(0, 0.1) if rng.random() < 0.5 else rng.uniform(0, 2 * np.pi)
    cosine, sine = texels_per_px * np.cos(turn), texels_per_px * np.sin(turn)
    shift = rng.uniform(0, 2 * side, 2)
    return np.array([[cosine, -sine, shift[0]], [sine, cosine, shift[1]]], np.float32)


def _draw_recolouring(rng: np.random.Generator) -> Float[np.ndarray, "3 4"]:
    """Of a texel's colour: a near-plain one in a fifth of the layers, else a change of gain, tint and hue."""
    if rng.random() < 0.2:
        contrast = rng.uniform(0.01, 0.08)
        base = natural_colour(rng) - contrast * 110
        return np.column_stack([contrast * np.eye(3), base]).astype(np.float32)
    gain = np.exp(rng.normal(0, 0.25) + rng.normal(0, 0.1, 3))
    mix = np.eye(3) * gain
    if rng.random() < 0.1:
        mix = mix[rng.permutation(3)]
    lift = rng.normal(0, 10)
    return np.column_stack([mix, np.full(3, lift)]).astype(np.float32)


def _draw_gloss(rng: np.random.Generator, place: Place) -> Float[np.ndarray, "6"]:
    """A highlight on a fifth of the layers; in the right view it has moved on the surface by up to 8 px."""
    if rng.random() < 0.8:
        return np.zeros(6, np.float32)
    x, y = rng.normal([place.x, place.y], place.radius_px / 2)
    inverse = 1 / (place.radius_px * rng.uniform(0.1, 0.5, 2) + 3)
    return np.array([x, y, inverse[0], inverse[1], rng.uniform(30, 160), rng.uniform(-8, 8)], np.float32)


def photograph(
    rng: np.random.Generator, left: Float[np.ndarray, "h w 3"], right: Float[np.ndarray, "h w 3"]
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w 3"]]:
    """The two images as two real cameras give them: a little apart in height, sharpness, tone and noise."""
    if rng.random() < CLEAN_SHARE:
        plain, still = np.tile(LEVELS, (3, 1)), np.zeros((3, LEVELS.size), np.float32)
        return expose(left, plain, still, left), expose(right, plain, still, right)
    if rng.random() < 0.33:
        right = _shifted_down(right, rng.uniform(-0.5, 0.5))
    # One pair in six has plainly different exposures, the others as two cameras of one make have.
    spread = 0.2 if rng.random() < 0.17 else 0.04
    noise_level = float(np.exp(rng.uniform(np.log(0.2), np.log(5)))) if rng.random() < 0.75 else 0.0
    blur_share = 0.5 if rng.random() < 0.4 else 0.0
    quality = int(rng.integers(50, 96)) if rng.random() < 0.25 else None
    vignette = rng.uniform(0.1, 0.4) if rng.random() < 0.06 else 0.0
    views = []
    for view in (left, right):
        if rng.random() < blur_share:
            view = cv2.GaussianBlur(view, (0, 0), rng.uniform(0.3, 0.9))
        if vignette:
            view = view * _vignette(view.shape[0], view.shape[1], vignette)
        tone = _draw_tone(rng, spread)
        # Photons are counted: their noise grows with the root of the brightness, over the sensor's own.
        deviation = noise_level * np.sqrt(0.25 + np.clip(tone, 0, 255) / 255)
        noise = rng.standard_normal(view.shape, np.float32) if noise_level else view
        shown = expose(view, tone, deviation, noise)
        views.append(shown if quality is None else _through_jpeg(shown, quality))
    return views[0], views[1]


def _draw_tone(rng: np.random.Generator, spread: float) -> Float[np.ndarray, "3 1021"]:
    gains = np.exp(rng.normal(0, spread) + rng.normal(0, min(spread, 0.06) / 2, 3))
    bent = 255 * (LEVELS / 255) ** np.exp(rng.normal(0, spread))
    return (gains[:, None] * bent + rng.normal(0, 30 * min(spread, 0.1))).astype(np.float32)


def _shifted_down(image: Float[np.ndarray, "h w 3"], shift_px: float) -> Float[np.ndarray, "h w 3"]:
    move = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, shift_px]])
    size = (image.shape[1], image.shape[0])
    moved = cv2.warpAffine(image, move, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.clip(moved, 0, 255)


def _vignette(height: int, width: int, strength: float) -> Float[np.ndarray, "h w 1"]:
    y, x = np.ogrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    return (1 - strength * (x * x + y * y) / 2).astype(np.float32)[..., None]


def _through_jpeg(image: UInt8[np.ndarray, "h w 3"], quality: int) -> UInt8[np.ndarray, "h w 3"]:
    _, data = cv2.imencode(
        ".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    return cv2.imdecode(data, cv2.IMREAD_COLOR_RGB)  # type: ignore[return-value]  # None only for bad data
