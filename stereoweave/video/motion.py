"""Motion from one frame of a video to another, and how much of the frame it explains."""

import typing

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

# In pixels at half size, where noise is half as strong and optical flow takes a quarter of the time.
_WINDOW_PX = 5
# OpenCV's optical flow crashes if a wide image has fewer rows than this.
_LEAST_SIDE_PX = 32
# A window is explained if its mean difference is at most this multiple of the median difference, which
# measures the image noise, plus an offset for clean images. The third number is the highest noise assumed.
_EXPLAINED, _LEAST_LEVELS, _NOISIEST_LEVELS = 1.5, 0.5, 6.0
# Motion always explains a little more than rest, because it also fits the noise.
_REST, _REST_LEVELS = 1.1, 0.25
# A pixel is calm if nothing moves in the window of this size around it.
_CALM_PX = 9
# Where the camera moves, images are resampled: differences may be larger by this share of the contrast. Such
# motion explains the image if it differs by at most the second multiple, plus the third number of levels, of
# what optical flow leaves, or by the fourth share of the contrast more. Speckles of this size are noise.
_RESAMPLED = 0.3
_MOVED, _MOVED_LEVELS, _MOVED_CONTRAST = 1.25, 0.5, 0.25
_SPECKLE_PX = 5
# A change of the mean grey level by more than this is a flash or a fast fade.
_FLASH_LEVELS = 20.0
# This filter is zero on a plane. Gaussian noise with a standard deviation of one level gives a standard
# deviation of 6 levels, and a median absolute value of 0.674 * 6 levels.
_ROUGHNESS = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_MEDIAN_ROUGHNESS = 6 * 0.674
# A window has contrast if its standard deviation exceeds this multiple of the noise level plus an offset.
_CONTRAST, _CONTRAST_LEVELS = 2.0, 1.0
# A window that differs by more than this share of its contrast shows something else, however faint.
_DIFFERENT_SHARE = 0.6
# In rendered videos, a frame up to three frames away explains over 0.35 of the windows with contrast, over
# 0.17 of them where the camera pans 8 times as fast as there, but less than 0.1 across a cut.
CUT_SHARE = 0.2
# Contrast in less than this share of an image may be a single object that appears without a cut.
_LEAST_CONTRAST_SHARE = 0.05


class Motion(typing.NamedTuple):
    """Motion from an image back to the previous image; arrays have half the image size, rounded up.

    Attributes:
        to_before_px: float32 [H2, W2, 2], offset from a pixel to its position in the previous image, in
            full-size pixels.
        explained: bool, true where the previous image looks the same at that position.
        calm: bool, true where nothing moves nearby.
        explained_share: Share of the windows with contrast that are explained; 1 if almost no window has
            contrast.
        rests: bool, true where the camera's motion explains the image as well as any other motion.
    """

    to_before_px: np.ndarray
    explained: np.ndarray
    calm: np.ndarray
    explained_share: float
    rests: np.ndarray


class CameraPath(typing.NamedTuple):
    """Motion of a view's points if only the camera moves; arrays have half the image size, rounded up.

    Attributes:
        to_before_px: float32 [H2, W2, 2], as in `Motion`.
        known: bool, false where the previous image did not show the point.
    """

    to_before_px: np.ndarray
    known: np.ndarray


class _Flow(typing.NamedTuple):
    """Optical flow at half size; arrays [H2, W2].

    Attributes:
        to_before_px: float32 [H2, W2, 2], in half-size pixels; 0 where the pixel rests.
        least_levels: Difference from the previous image there, in grey levels.
        rests: bool, true where rest explains the pixel as well as motion does.
    """

    to_before_px: np.ndarray
    least_levels: np.ndarray
    rests: np.ndarray


def convert_to_grey(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w"]:
    """Convert an RGB image to grey."""
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def halve(grey: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h2 w2"]:
    """Scale a grey image down to half its size, rounded up."""
    height, width = grey.shape
    return cv2.resize(grey, ((width + 1) // 2, (height + 1) // 2), interpolation=cv2.INTER_AREA)


def measure_motion(
    before: UInt8[np.ndarray, "h2 w2"],
    grey: UInt8[np.ndarray, "h2 w2"],
    camera_path: CameraPath | None = None,
    *,
    paths_only: bool = False,
) -> Motion:
    """Measure the motion from a grey image back to the previous image, both at half size.

    Args:
        before: The previous image.
        grey: The image.
        camera_path: Where points would have been if only the camera moved; None if it rests.
        paths_only: Leave out `calm` and `explained_share`, which only the filter needs.
    """
    before = match_brightness(before, grey)
    flow, least_levels, rests = _find_flow(before, grey)
    median_levels = min(float(np.median(least_levels[::4, ::4])), _NOISIEST_LEVELS)
    allowed_levels: float | Float[np.ndarray, "h2 w2"] = _EXPLAINED * median_levels + _LEAST_LEVELS
    if camera_path is None:
        explained = least_levels <= allowed_levels
    else:
        known = camera_path.known
        camera_levels = _measure_difference_levels(grey, _warp(before, camera_path.to_before_px / 2))
        contrast_levels = _measure_contrast_levels(grey)
        allowed_levels = allowed_levels + _RESAMPLED * contrast_levels
        as_well_levels = np.maximum(
            _MOVED * least_levels + _MOVED_LEVELS, _REST * least_levels + _MOVED_CONTRAST * contrast_levels
        )
        rests = known & (camera_levels <= as_well_levels)
        least_levels = np.where(known, np.minimum(least_levels, camera_levels), least_levels)
        flow[rests] = camera_path.to_before_px[rests] / 2
        explained = least_levels <= allowed_levels
    if paths_only:
        return Motion(2 * flow, explained, rests, 1.0, rests)
    moves = (~(rests & explained)).astype(np.uint8)
    if camera_path is not None:
        # What the camera uncovers is new, but does not move.
        moves = cv2.medianBlur(moves & camera_path.known, _SPECKLE_PX)
    calm = cv2.erode(1 - moves, np.ones((_CALM_PX, _CALM_PX), np.uint8)).astype(bool)
    share = _measure_explained_share(grey, least_levels, explained)
    return Motion(2 * flow, explained, calm, share, rests)


def _find_flow(before: UInt8[np.ndarray, "h2 w2"], grey: UInt8[np.ndarray, "h2 w2"]) -> _Flow:
    """Find the flow from a grey image back to another one of the same brightness."""
    height, width = grey.shape
    more = max(0, _LEAST_SIDE_PX - height), max(0, _LEAST_SIDE_PX - width)
    seen, shown = (
        cv2.copyMakeBorder(image, 0, more[0], 0, more[1], cv2.BORDER_REPLICATE) for image in (grey, before)
    )
    rest = np.zeros((*seen.shape, 2), np.float32)
    method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    flow = np.ascontiguousarray(method.calc(seen, shown, rest)[:height, :width])
    moved_levels = _measure_difference_levels(grey, _warp(before, flow))
    rest_levels = _measure_difference_levels(grey, before)
    rests = rest_levels <= _REST * moved_levels + _REST_LEVELS
    flow[rests] = 0
    return _Flow(flow, np.minimum(moved_levels, rest_levels), rests)


def _measure_explained_share(
    grey: UInt8[np.ndarray, "h2 w2"],
    least_levels: Float[np.ndarray, "h2 w2"],
    explained: Bool[np.ndarray, "h2 w2"],
) -> float:
    """Return the share of windows with contrast that are explained; 1 if almost no window has contrast."""
    contrast_levels = _measure_contrast_levels(grey)
    has_contrast = contrast_levels > _CONTRAST * _estimate_noise_levels(grey) + _CONTRAST_LEVELS
    if has_contrast.mean() < _LEAST_CONTRAST_SHARE:
        return 1.0
    alike = explained & (least_levels < _DIFFERENT_SHARE * contrast_levels)
    return float(alike[has_contrast].mean())


def _measure_contrast_levels(grey: UInt8[np.ndarray, "h2 w2"]) -> Float[np.ndarray, "h2 w2"]:
    """Return the standard deviation of the grey levels in a window around each pixel."""
    window = (_WINDOW_PX, _WINDOW_PX)
    squares = cv2.sqrBoxFilter(grey, cv2.CV_32F, window)
    variance = squares - cv2.boxFilter(grey, cv2.CV_32F, window) ** 2
    return np.sqrt(np.maximum(variance, 0))


def _estimate_noise_levels(grey: UInt8[np.ndarray, "h2 w2"]) -> float:
    """Return the standard deviation of the noise in grey levels, estimated from the median roughness."""
    roughness = cv2.filter2D(grey, cv2.CV_32F, _ROUGHNESS)
    return float(np.median(np.abs(roughness[::4, ::4]))) / _MEDIAN_ROUGHNESS


def match_brightness(
    before: UInt8[np.ndarray, "h2 w2"], grey: UInt8[np.ndarray, "h2 w2"]
) -> UInt8[np.ndarray, "h2 w2"]:
    """Return the previous image with the mean and contrast of the new image.

    Otherwise, a fade would count as a change of the scene. After a large change, as in a flash that makes a
    part of the image white, each grey level becomes the level of the same rank in the new image.
    """
    (old_mean, old_contrast), (mean, contrast) = (
        [float(value[0, 0]) for value in cv2.meanStdDev(picture)] for picture in (before, grey)
    )
    if abs(mean - old_mean) > _FLASH_LEVELS:
        return _match_ranks(before, grey)
    gain = contrast / max(old_contrast, 1.0)
    return cv2.addWeighted(before, gain, before, 0, mean - gain * old_mean)


def _match_ranks(
    before: UInt8[np.ndarray, "h2 w2"], grey: UInt8[np.ndarray, "h2 w2"]
) -> UInt8[np.ndarray, "h2 w2"]:
    """Return the previous image with the histogram of the new image."""
    counts, shown = (np.bincount(image.ravel(), minlength=256).cumsum() for image in (before, grey))
    # The middle of a level's ranks decides, so that a level of many pixels is not moved up.
    ranks = counts - np.diff(counts, prepend=0) / 2
    levels = np.searchsorted(shown, ranks * (shown[-1] / counts[-1])).clip(0, 255)
    return cv2.LUT(before, levels.astype(np.uint8))


def _warp(
    before: UInt8[np.ndarray, "h2 w2"], flow: Float[np.ndarray, "h2 w2 2"]
) -> UInt8[np.ndarray, "h2 w2"]:
    height, width = before.shape
    rows, columns = np.indices((height, width), np.float32)
    source = flow[..., 0] + columns, flow[..., 1] + rows
    return cv2.remap(before, *source, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _measure_difference_levels(
    a: UInt8[np.ndarray, "h2 w2"], b: UInt8[np.ndarray, "h2 w2"]
) -> Float[np.ndarray, "h2 w2"]:
    """Return the mean absolute difference of two images in a window around each pixel, in grey levels."""
    return cv2.boxFilter(cv2.absdiff(a, b), cv2.CV_32F, (_WINDOW_PX, _WINDOW_PX))
