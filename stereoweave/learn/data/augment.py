"""Augmentation of pairs by cropping, scaling, mirroring, recolouring and erasing patches."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from stereoweave.errors import StereoweaveError
from stereoweave.stereo import Sample, StereoCamera, scale_camera


def crop(sample: Sample, height: int, width: int, rng: np.random.Generator) -> Sample:
    """Crop the sample at a random position without scaling it.

    Raises:
        StereoweaveError: The sample is smaller than the crop.
    """
    rows, columns = sample.disparity_px.shape
    if rows < height or columns < width:
        raise StereoweaveError(
            f"crop_size = {[height, width]}, expected at most {[rows, columns]}, the size of the pictures; "
            "use a smaller crop"
        )
    top, start = int(rng.integers(rows - height + 1)), int(rng.integers(columns - width + 1))
    part = np.s_[top : top + height, start : start + width]
    maps = {name: value[part] for name, value in vars(sample).items() if name != "camera"}
    return Sample(**maps, camera=crop_camera(sample.camera, start, top))


# Largest shift of the right crop to the right, as a share of its width.
_LARGEST_OFFSET = 0.14


def augment(
    sample: Sample, height: int, width: int, rng: np.random.Generator, offset_share: float = 0.0
) -> Sample:
    """Crop and augment the sample; its disparity is scaled and shifted accordingly.

    Args:
        sample: The sample to augment.
        height: Height of the crop in px.
        width: Width of the crop in px.
        rng: Random number generator.
        offset_share: Share of samples whose right crop is shifted to the right by up to 14 % of the width.
            This increases their disparity, so that textureless surfaces are not always far away.
    """
    offset = rng.uniform(0, _LARGEST_OFFSET) if offset_share and rng.random() < offset_share else 0.0
    sample = crop_and_scale(sample, height, width, rng, offset)
    # Without the right view's disparity, a mirrored pair has no ground truth.
    if rng.random() < 0.5 and np.isfinite(sample.right_disparity_px).any():
        sample = mirror(sample)
    if rng.random() < 0.3:
        sample = flip_rows(sample)
    left, right = recolour(sample.left, sample.right, rng)
    if rng.random() < 0.4:
        right = erase_patches(right, rng)
    return replace(sample, left=left, right=right)


# Most rows and columns that `pad` replaces, as a share of all.
_MOST_PADDING = 0.25


def pad(sample: Sample, rng: np.random.Generator) -> Sample:
    """Replace up to a quarter of the rows, at the bottom, and of the columns, on the right, by padding.

    Padding repeats the last row and column that remain; `Matcher` also pads above and on the left. The
    disparity of padding is unknown. Pixels of the right view are occluded if they show what was only in the
    replaced part of the left view.
    """
    rows, columns = sample.disparity_px.shape
    height, width = (side - int(rng.integers(int(side * _MOST_PADDING) + 1)) for side in (rows, columns))
    around = (0, rows - height), (0, columns - width)

    def picture(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        return np.pad(image[:height, :width], (*around, (0, 0)), mode="edge")

    def extend(values: np.ndarray, value: float) -> np.ndarray:
        return np.pad(values[:height, :width], around, constant_values=value)

    seen_px = np.arange(columns) + np.nan_to_num(sample.right_disparity_px)
    return replace(
        sample,
        left=picture(sample.left),
        right=picture(sample.right),
        disparity_px=extend(sample.disparity_px, np.nan),
        right_disparity_px=extend(sample.right_disparity_px, np.nan),
        occluded=extend(sample.occluded, False),
        right_occluded=extend(sample.right_occluded | (seen_px > width - 1), False),
    )


def crop_and_scale(
    sample: Sample, height: int, width: int, rng: np.random.Generator, offset: float = 0.0
) -> Sample:
    """Crop the sample at a random position, and scale the crop and its disparity to height x width.

    The right view's crop is shifted right by `offset`, a share of its width, as far as the sample allows.
    """
    rows, columns = sample.disparity_px.shape
    smallest = max(height / rows, width / columns)
    scale = max(smallest, float(np.exp(rng.uniform(np.log(0.75), np.log(1.4)))))
    # Height and width are scaled slightly differently, as if pixels were not square.
    stretch = float(np.exp(rng.uniform(-0.1, 0.1)))
    scale_y = max(scale * stretch, height / rows)
    part_height, part_width = min(round(height / scale_y), rows), min(round(width / scale), columns)
    top = int(rng.integers(rows - part_height + 1))
    offset_px = min(round(offset * part_width), columns - part_width)
    start = int(rng.integers(columns - part_width - offset_px + 1))
    rows_of_part = slice(top, top + part_height)
    here = rows_of_part, slice(start, start + part_width)
    there = rows_of_part, slice(start + offset_px, start + offset_px + part_width)
    scale_x = width / part_width
    camera = sample.camera and replace(sample.camera, doffs_px=sample.camera.doffs_px - offset_px)

    def picture(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
        shrinks = scale_x < 1 or height < part_height
        return cv2.resize(
            image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        )

    def nearest(values: np.ndarray) -> np.ndarray:
        # An average across an edge would be the disparity of neither side.
        return cv2.resize(values, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)

    def disparity_px(values: np.ndarray) -> np.ndarray:
        return (nearest(values) + np.float32(offset_px)) * np.float32(scale_x)

    return Sample(
        left=picture(sample.left[here]),
        right=picture(sample.right[there]),
        disparity_px=disparity_px(sample.disparity_px[here]),
        right_disparity_px=disparity_px(sample.right_disparity_px[there]),
        occluded=nearest(sample.occluded[here].astype(np.uint8)) > 0,
        right_occluded=nearest(sample.right_occluded[there].astype(np.uint8)) > 0,
        camera=crop_camera(camera, start, top, scale_x, height / part_height),
    )


def crop_camera(
    camera: StereoCamera | None, start_px: int, top_px: int, scale_x: float = 1.0, scale_y: float = 1.0
) -> StereoCamera | None:
    """Return the camera of a crop that starts at the given column and row and is then scaled."""
    if camera is None:
        return None
    cropped = replace(camera, cx_px=camera.cx_px - start_px, cy_px=camera.cy_px - top_px)
    return scale_camera(cropped, scale_x, scale_y)


def mirror(sample: Sample) -> Sample:
    """Mirror the sample left to right, which swaps its views."""
    camera = sample.camera
    last = sample.left.shape[1] - 1
    return Sample(
        left=sample.right[:, ::-1],
        right=sample.left[:, ::-1],
        disparity_px=sample.right_disparity_px[:, ::-1],
        right_disparity_px=sample.disparity_px[:, ::-1],
        occluded=sample.right_occluded[:, ::-1],
        right_occluded=sample.occluded[:, ::-1],
        camera=camera and replace(camera, cx_px=last - camera.cx_px - camera.doffs_px),
    )


def flip_rows(sample: Sample) -> Sample:
    """Flip the sample upside down."""
    maps = {name: value[::-1] for name, value in vars(sample).items() if name != "camera"}
    camera, last = sample.camera, sample.left.shape[0] - 1
    return Sample(**maps, camera=camera and replace(camera, cy_px=last - camera.cy_px))


def recolour(
    left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"], rng: np.random.Generator
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w 3"]]:
    """Apply a random colour change to both views, and a small separate change to each view."""
    order = rng.permutation(3) if rng.random() < 0.3 else np.arange(3)
    gain, gamma = rng.uniform(0.7, 1.3, 3) * rng.uniform(0.7, 1.3), rng.uniform(0.7, 1.4)
    tables = []
    for _ in range(2):
        own_gain, own_gamma = gain * rng.uniform(0.95, 1.05, 3), gamma * rng.uniform(0.96, 1.04)
        tables.append(_make_colour_table(own_gain, own_gamma))
    return cv2.LUT(left[..., order], tables[0]), cv2.LUT(right[..., order], tables[1])


def _make_colour_table(gain: Float[np.ndarray, "3"], gamma: float) -> UInt8[np.ndarray, "256 1 3"]:
    curve = (np.arange(256) / 255) ** gamma
    return np.clip(255 * curve[:, None, None] * gain, 0, 255).astype(np.uint8)


def erase_patches(image: UInt8[np.ndarray, "h w 3"], rng: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
    """Fill one or two patches with their mean colour, so that their match must be inferred."""
    image = image.copy()
    rows, columns = image.shape[:2]
    for _ in range(rng.integers(1, 3)):
        height, width = np.minimum(rng.integers(16, 64, 2), (rows, columns))
        top, start = rng.integers(rows - height + 1), rng.integers(columns - width + 1)
        patch = image[top : top + height, start : start + width]
        patch[:] = patch.mean((0, 1))
    return image
