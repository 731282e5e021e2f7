"""Unlimited training pairs: collages of flat, slanted and bent surfaces, painted into both views.

For accuracy on photographs, natural textures and a wide range of disparities matter more than realistic
geometry. Disparity and occlusion are nevertheless exact in both views.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stereoweave.learn.data.collage_kinds import draw_scene, draw_training_scene
from stereoweave.learn.data.collage_scene import CollageScene
from stereoweave.learn.data.paint_kernels import Sheet, colour, cover, expose, find_occluded, warp_to_right
from stereoweave.learn.data.textures import LIGHT_MAPS, draw_natural_colour, make_light_map
from stereoweave.stereo import Sample

CLEAN_SHARE = 0.25  # share of pairs without photometric differences
FAULTY_SHARE = 0.03  # share of pairs with the faults of poor cameras
NOISE_SHARE = 0.02  # share of training pairs that show nothing but noise
SHIFTED_APART_SHARE = 0.04  # share of training pairs with partly negative disparities
NOTHING_PX = -1000.0  # disparity of pixels without a match; negative even after the views are shifted
LEVELS = np.arange(1021, dtype=np.float32) / 4  # grey levels that a tone curve distinguishes


View = Float[np.ndarray, "h w 3"]  # 0..255


@dataclass(frozen=True, kw_only=True)
class PaintedView:
    """Image of one view, float32 [H, W, 3] in 0..255, and its disparity, float32 [H, W]."""

    image: Float[np.ndarray, "h w 3"]
    disparity_px: Float[np.ndarray, "h w"]


def paint_collage(seed: int, epoch: int, index: int, height: int = 256, width: int = 384) -> Sample:
    """Paint the mixed collage with the given index, and its exact disparity and occlusion in both views.

    The same arguments give the same pair in every process. Disparities are finite and >= 0. The first call
    builds the textures, which takes a few seconds.
    """
    rng = np.random.default_rng((seed, epoch, index))
    return _make_sample(rng, *_paint_matchable(rng, draw_scene, height, width))


def paint_training_collage(seed: int, epoch: int, index: int, height: int = 256, width: int = 384) -> Sample:
    """Paint a collage of any kind, in the format of `paint_collage`.

    6 % of the pairs train only the confidence. Some or all of their disparities are below 0, where a network
    that clamps at 0 cannot find them. Either the crops of the two views are shifted apart, which gives exact
    disparities of both signs, or both views show plain noise, and every disparity is NOTHING_PX.
    """
    rng = np.random.default_rng((seed, epoch, index, 1))
    kind = rng.random()
    if kind < NOISE_SHARE:
        return _paint_plain_noise(rng, height, width)
    if kind < NOISE_SHARE + SHIFTED_APART_SHARE:
        views = _paint_matchable(rng, draw_training_scene, height, width + width // 4)
        return _make_sample(rng, *_crop_apart(rng, *views, width))
    return _make_sample(rng, *_paint_matchable(rng, draw_training_scene, height, width))


def _paint_matchable(
    rng: np.random.Generator,
    draw: Callable[[np.random.Generator, int, int], CollageScene],
    height: int,
    width: int,
) -> tuple[PaintedView, PaintedView]:
    """Paint both views of random scenes until one has enough contrast and few enough occluded pixels."""
    while True:
        left, right = paint_scene(draw(rng, height, width))
        occluded, right_occluded = _find_occlusions(left, right)
        if occluded.mean() < 0.6 and right_occluded.mean() < 0.6 and left.image.std() > 6:
            return left, right


def _find_occlusions(
    left: PaintedView, right: PaintedView
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    return (
        find_occluded(left.disparity_px, right.disparity_px, -1),
        find_occluded(right.disparity_px, left.disparity_px, 1),
    )


def _make_sample(rng: np.random.Generator, left: PaintedView, right: PaintedView) -> Sample:
    occluded, right_occluded = _find_occlusions(left, right)
    left_image, right_image = simulate_cameras(rng, left.image, right.image)
    return Sample(
        left=left_image,
        right=right_image,
        disparity_px=left.disparity_px,
        right_disparity_px=right.disparity_px,
        occluded=occluded,
        right_occluded=right_occluded,
    )


def _crop_apart(
    rng: np.random.Generator, left: PaintedView, right: PaintedView, width: int
) -> tuple[PaintedView, PaintedView]:
    """Crop both views to `width`, with the left crop so far right that many disparities are below 0."""
    spare = left.image.shape[1] - width
    start = int(np.clip(np.ceil(np.quantile(left.disparity_px, rng.uniform(0.1, 0.7))), 1, spare))

    def cut(view: PaintedView, first: int) -> PaintedView:
        columns = np.s_[:, first : first + width]
        return PaintedView(
            image=view.image[columns], disparity_px=view.disparity_px[columns] - np.float32(start)
        )

    return cut(left, start), cut(right, 0)


def _paint_plain_noise(rng: np.random.Generator, height: int, width: int) -> Sample:
    """Paint two views of a single colour under smooth light, each with its own sensor noise."""
    light = 1 + rng.uniform(0, 0.3) * (make_light_map(int(rng.integers(LIGHT_MAPS))) - 1)
    shown = (
        draw_natural_colour(rng)
        * cv2.resize(light, (width, height), interpolation=cv2.INTER_CUBIC)[..., None]
    )
    level = np.exp(rng.uniform(np.log(0.5), np.log(12)))
    views = [shown + level * rng.standard_normal(shown.shape, np.float32) for _ in range(2)]
    left, right = (np.clip(np.round(view), 0, 255).astype(np.uint8) for view in views)
    nothing_px = np.full((height, width), NOTHING_PX, np.float32)
    nowhere = np.ones((height, width), bool)
    return Sample(
        left=left,
        right=right,
        disparity_px=nothing_px,
        right_disparity_px=nothing_px,
        occluded=nowhere,
        right_occluded=nowhere,
    )


def paint_scene(scene: CollageScene) -> tuple[PaintedView, PaintedView]:
    """Paint the left and right views of a scene as ideal cameras would see it."""
    left_sheets = [layer.sheet() for layer in scene.layers]
    right_sheets = [warp_to_right(sheet, scene.width) for sheet in left_sheets]
    return _paint_view(scene, left_sheets, 0), _paint_view(scene, right_sheets, 1)


def _paint_view(scene: CollageScene, sheets: list[Sheet], side: int) -> PaintedView:
    nearest = np.full((scene.height, scene.width), -1, np.float32)
    nearest_opaque = nearest.copy()
    image = np.full((scene.height, scene.width, 3), 0, np.float32)
    for sheet in sheets:
        cover(sheet, nearest, nearest_opaque)
    for layer, sheet in zip(scene.layers, sheets, strict=True):
        colour(image, sheet, layer.paint, nearest_opaque, side)
    return PaintedView(image=image, disparity_px=nearest)


def simulate_cameras(
    rng: np.random.Generator, left: Float[np.ndarray, "h w 3"], right: Float[np.ndarray, "h w 3"]
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w 3"]]:
    """Simulate two real cameras that differ slightly in height, sharpness, tone and noise."""
    # A separate generator, so that pairs without faults stay the same as before faults were introduced.
    fault_rng = rng.spawn(1)[0]
    if fault_rng.random() < FAULTY_SHARE:
        left, right = _add_faults(fault_rng, left, right)
    if rng.random() < CLEAN_SHARE:
        plain, still = np.tile(LEVELS, (3, 1)), np.zeros((3, LEVELS.size), np.float32)
        return expose(left, plain, still, left), expose(right, plain, still, right)
    if rng.random() < 0.33:
        right = _shift_down(right, rng.uniform(-0.5, 0.5))
    # One pair in six has clearly different exposures. In the others, exposures differ as they do between two
    # cameras of the same model.
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
            view = view * _make_vignette(view.shape[0], view.shape[1], vignette)
        tone = _draw_tone(rng, spread)
        # Shot noise grows with the square root of the brightness, in addition to sensor noise.
        deviation = noise_level * np.sqrt(0.25 + np.clip(tone, 0, 255) / 255)
        noise = rng.standard_normal(view.shape, np.float32) if noise_level else view
        shown = expose(view, tone, deviation, noise)
        views.append(shown if quality is None else _compress_jpeg(shown, quality))
    return views[0], views[1]


def _add_faults(rng: np.random.Generator, left: View, right: View) -> tuple[View, View]:
    """Apply one to three faults, in the order in which they occur in a camera."""
    for fault in np.sort(rng.choice(len(FAULTS), rng.integers(1, 4), replace=False)):
        left, right = FAULTS[fault](rng, left, right)
    return left, right


def _misalign_rows(rng: np.random.Generator, left: View, right: View) -> tuple[View, View]:
    """Shift the right view up or down by 0.8 to 2 rows."""
    return left, _shift_down(right, rng.choice([-1, 1]) * rng.uniform(0.8, 2))


def _blur_one(rng: np.random.Generator, left: View, right: View) -> tuple[View, View]:
    """Blur one of the views as if its lens were out of focus."""
    deviation_px, which = rng.uniform(0.7, 1.6), rng.integers(2)
    if which:
        return left, cv2.GaussianBlur(right, (0, 0), deviation_px)
    return cv2.GaussianBlur(left, (0, 0), deviation_px), right


def _darken_corners(rng: np.random.Generator, left: View, right: View) -> tuple[View, View]:
    """Darken the corners of both views by different amounts."""
    own, other = (_make_vignette(left.shape[0], left.shape[1], rng.uniform(0.2, 0.7)) for _ in range(2))
    return left * own, right * other


def _interpolate_colours(rng: np.random.Generator, left: View, right: View) -> tuple[View, View]:
    """Demosaic one or both views, as cameras with a Bayer filter do."""
    which = rng.integers(3)
    return left if which == 1 else demosaic(left), right if which == 2 else demosaic(right)


FAULTS = (_misalign_rows, _blur_one, _darken_corners, _interpolate_colours)


def demosaic(image: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Sample the image (0..255) through a Bayer filter and interpolate the missing colours."""
    levels = np.round(image * 256).astype(np.uint16)
    mosaic = levels[..., 1].copy()
    mosaic[::2, ::2], mosaic[1::2, 1::2] = levels[::2, ::2, 0], levels[1::2, 1::2, 2]
    return cv2.demosaicing(mosaic, cv2.COLOR_BayerBG2RGB).astype(np.float32) / 256


def _draw_tone(rng: np.random.Generator, spread: float) -> Float[np.ndarray, "3 1021"]:
    gains = np.exp(rng.normal(0, spread) + rng.normal(0, min(spread, 0.06) / 2, 3))
    bent = 255 * (LEVELS / 255) ** np.exp(rng.normal(0, spread))
    return (gains[:, None] * bent + rng.normal(0, 30 * min(spread, 0.1))).astype(np.float32)


def _shift_down(image: Float[np.ndarray, "h w 3"], shift_px: float) -> Float[np.ndarray, "h w 3"]:
    move = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, shift_px]])
    size = (image.shape[1], image.shape[0])
    moved = cv2.warpAffine(image, move, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.clip(moved, 0, 255)


def _make_vignette(height: int, width: int, strength: float) -> Float[np.ndarray, "h w 1"]:
    y, x = np.ogrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    return (1 - strength * (x * x + y * y) / 2).astype(np.float32)[..., None]


def _compress_jpeg(image: UInt8[np.ndarray, "h w 3"], quality: int) -> UInt8[np.ndarray, "h w 3"]:
    _, data = cv2.imencode(
        ".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    return cv2.imdecode(data, cv2.IMREAD_COLOR_RGB)  # type: ignore[return-value]  # None only for bad data
