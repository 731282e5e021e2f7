"""Replacement for OpenCV's stereo matchers that runs the shipped networks."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Int16, UInt8

from stereoweave.arguments import check_flag, check_number, describe, is_plain_array
from stereoweave.errors import StereoweaveError
from stereoweave.io.arrays import as_rgb, describe_kind
from stereoweave.matching.backend import Backend
from stereoweave.matching.estimate import match
from stereoweave.matching.opencv_interface.settings import Rectangle, Settings
from stereoweave.matching.options import MatchOptions
from stereoweave.matching.providers import CPU
from stereoweave.stereo import StereoPair

_STEPS_PER_PX = 16
_LARGEST_STEP = 2**16


class StereoMatcher(Settings):
    """Replacement for cv2.StereoSGBM and cv2.StereoBM; `compute` returns int16 disparities in 1/16 px.

    It takes StereoSGBM's arguments in its order, and has the methods of both classes. These parameters mean
    the same as in OpenCV: minDisparity, numDisparities (which need not be a multiple of 16),
    speckleWindowSize, speckleRange, and StereoBM's ROI1 and ROI2. All others belong to OpenCV's algorithms: a
    getter returns what was set, but they have no effect. The network's own left-right check and confidence
    take the place of disp12MaxDiff, uniquenessRatio and textureThreshold.

    Args:
        minDisparity: Least disparity in px; negative for converged cameras.
        numDisparities: Number of disparities from minDisparity.
        blockSize: No effect.
        P1: No effect.
        P2: No effect.
        disp12MaxDiff: No effect.
        preFilterCap: No effect.
        uniquenessRatio: No effect.
        speckleWindowSize: Areas of at most this many pixels whose disparity differs from that around them
            become invalid; 0 keeps all areas.
        speckleRange: Greatest difference in px between neighbouring pixels of one such area.
        mode: No effect.
        model: Name of a shipped network, or path of an .onnx matcher file.
        threads: Maximum number of threads per call; default: all cores.
        provider: See `stereoweave.estimate`.
        refined: See `stereoweave.estimate`.
        min_confidence: Least confidence of a valid pixel.
    """

    def __init__(  # noqa: PLR0913 - StereoSGBM's parameters, and a matcher's
        self,
        minDisparity: int = 0,
        numDisparities: int = 192,
        blockSize: int = 3,
        P1: int = 0,
        P2: int = 0,
        disp12MaxDiff: int = 0,
        preFilterCap: int = 0,
        uniquenessRatio: int = 0,
        speckleWindowSize: int = 0,
        speckleRange: int = 0,
        mode: int = 0,
        *,
        model: str | Path = "small",
        threads: int | None = None,
        provider: str = CPU,
        refined: bool = False,
        min_confidence: float = 0.5,
    ) -> None:
        super().__init__(
            minDisparity=minDisparity,
            numDisparities=numDisparities,
            blockSize=blockSize,
            speckleWindowSize=speckleWindowSize,
            speckleRange=speckleRange,
            disp12MaxDiff=disp12MaxDiff,
            preFilterCap=preFilterCap,
            uniquenessRatio=uniquenessRatio,
            P1=P1,
            P2=P2,
            mode=mode,
        )
        min_confidence = check_number("min_confidence", min_confidence)
        check_flag("refined", refined)
        self._refined, self._min_confidence = refined, min_confidence
        if not 0 <= min_confidence <= 1:
            raise StereoweaveError(
                f"min_confidence: expected a probability from 0 to 1, found {min_confidence}"
            )
        self._matcher = Backend(model=model, threads=threads, provider=provider).matcher()

    @classmethod
    def create(cls, *arguments: int, **settings: Any) -> "StereoMatcher":
        """Return a new matcher, as cv2.StereoSGBM.create does; the arguments are those of the class."""
        return cls(*arguments, **settings)

    def __repr__(self) -> str:
        range_px = f"minDisparity={self.getMinDisparity()}, numDisparities={self.getNumDisparities()}"
        return f"StereoMatcher({range_px}, model={self._matcher.model!r})"

    def compute(
        self,
        left: UInt8[np.ndarray, "h w *channels"],
        right: UInt8[np.ndarray, "h w *channels"],
        disparity: np.ndarray | None = None,
    ) -> Int16[np.ndarray, "h w"]:
        """Return the left image's disparity in 1/16 px; invalid pixels are (minDisparity - 1) * 16.

        A pixel is invalid if it is occluded, if its confidence is below min_confidence, if it or its match is
        outside the region of interest of its image, or if it belongs to a speckle. A disparity outside
        minDisparity to minDisparity + numDisparities is clipped; by more than 1 px, its confidence is 0.

        Args:
            left: Left image of a rectified pair, as returned by cv2.imread: BGR or grey, uint8.
            right: Right image of the same size.
            disparity: Array [H, W], int16, that receives the result and is returned. As in OpenCV, an array
                of another shape or type is left unchanged, and a new one is returned.
        """
        if disparity is not None:
            _check_output(disparity)
        left, right = _rgb_of_bgr(left, "left picture"), _rgb_of_bgr(right, "right picture")
        pair = StereoPair(
            left=left,
            right=right,
            left_seen=_inside(self.getROI1(), left),
            right_seen=_inside(self.getROI2(), right),
        )
        found = self._find(pair)
        if disparity is None or (disparity.shape, disparity.dtype) != (found.shape, found.dtype):
            return found
        disparity[:] = found
        return disparity

    def _find(self, pair: StereoPair) -> Int16[np.ndarray, "h w"]:
        least_px, most_px = self.getMinDisparity(), self.getMinDisparity() + self.getNumDisparities()
        options = MatchOptions(range_px=(least_px, most_px), refined=self._refined)
        try:
            found = match(self._matcher, pair, options)
        except StereoweaveError as error:
            if error.setting != "range_px":
                raise
            raise StereoweaveError(f"minDisparity, numDisparities: {error.message}") from error
        known = ~found.occluded & (found.confidence >= self._min_confidence)
        if pair.left_seen is not None:
            known &= pair.left_seen
        invalid = (least_px - 1) * _STEPS_PER_PX
        steps = np.where(known, np.rint(found.disparity_px * _STEPS_PER_PX), invalid).astype(np.int16)
        if self.getSpeckleWindowSize() > 0:
            # All larger values have the same effect, but may overflow in OpenCV.
            greatest_step = int(np.clip(self.getSpeckleRange() * _STEPS_PER_PX, 0, _LARGEST_STEP))
            cv2.filterSpeckles(steps, invalid, self.getSpeckleWindowSize(), greatest_step)
        return steps


def _inside(region: Rectangle, image: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"] | None:
    """Return the mask of a region of interest; None if the region is empty, which means the whole image."""
    x, y, width, height = region
    if width <= 0 or height <= 0:
        return None
    mask = np.zeros(image.shape[:2], bool)
    mask[max(y, 0) : max(y + height, 0), max(x, 0) : max(x + width, 0)] = True
    return mask


def _check_output(disparity: object) -> None:
    if not is_plain_array(disparity) or not disparity.flags.writeable:
        raise StereoweaveError(
            f"disparity: expected a writable array for the result, int16 [H, W], got {describe(disparity)}"
        )


def _rgb_of_bgr(picture: UInt8[np.ndarray, "h w *channels"], name: str) -> UInt8[np.ndarray, "h w 3"]:
    # PIL images and tensors are RGB and would be misread as BGR.
    if not isinstance(picture, np.ndarray) or picture.dtype != np.uint8:
        raise StereoweaveError(
            f"{name}: expected a uint8 array, BGR [H, W, 3] or grey [H, W], as returned by cv2.imread, "
            f"got {picture.dtype if isinstance(picture, np.ndarray) else describe_kind(picture)}"
        )
    return np.ascontiguousarray(as_rgb(picture, name)[..., ::-1])
