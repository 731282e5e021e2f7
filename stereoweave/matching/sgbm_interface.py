"""The shipped network behind the call of OpenCV's stereo matchers, for programs written for StereoSGBM."""

from pathlib import Path

import numpy as np
from jaxtyping import Int16, UInt8

from stereoweave.arguments import check_flag, check_number, check_whole_number
from stereoweave.errors import StereoweaveError
from stereoweave.io.arrays import as_rgb
from stereoweave.matching.backend import Backend
from stereoweave.matching.estimate import match
from stereoweave.matching.options import MatchOptions
from stereoweave.matching.providers import CPU
from stereoweave.stereo import StereoPair

_STEPS_PER_PX = 16
_LARGEST_PX = 2047


class StereoMatcher:
    """Takes the place of cv2.StereoSGBM: `compute` gives int16 disparity * 16, as its users expect it.

    The two parameters have OpenCV's names and meaning. Those that steer OpenCV's way of matching (blockSize,
    P1, P2, disp12MaxDiff, preFilterCap, uniquenessRatio, speckleWindowSize, speckleRange, mode) mean nothing
    to a network: handed in, they are a TypeError.

    Args:
        minDisparity: The least disparity that is looked for, in px; below 0 for converged cameras.
        numDisparities: How many are, from minDisparity on; any number, where OpenCV demands a multiple of 16.
        model: A shipped name or the path of an .onnx matcher.
        threads: How many threads a call may use; all cores if left out.
        provider: As for `stereoweave.estimate`.
        refined: As for `stereoweave.estimate`.
        min_confidence: Pixels whose disparity is less likely than this to be within 1 px are invalid.
    """

    def __init__(  # noqa: PLR0913 - OpenCV's two, and what makes a matcher
        self,
        minDisparity: int = 0,
        numDisparities: int = 192,
        *,
        model: str | Path = "small",
        threads: int | None = None,
        provider: str = CPU,
        refined: bool = False,
        min_confidence: float = 0.5,
    ) -> None:
        check_number("min_confidence", min_confidence)
        check_flag("refined", refined)
        self._least_px, self._count, self._refined = minDisparity, numDisparities, refined
        self._min_confidence = min_confidence
        if not 0 <= min_confidence <= 1:
            raise StereoweaveError(f"min_confidence: expected a probability, 0 to 1, found {min_confidence}")
        self._check_range()
        self._matcher = Backend(model=model, threads=threads, provider=provider).matcher()

    def compute(
        self, left: UInt8[np.ndarray, "h w *channels"], right: UInt8[np.ndarray, "h w *channels"]
    ) -> Int16[np.ndarray, "h w"]:
        """Disparity of the left picture in px * 16, and (minDisparity - 1) * 16 where it is not known.

        It is not known where the left camera alone sees, where the confidence is below min_confidence, and
        where the disparity is outside of minDisparity to minDisparity + numDisparities.

        Args:
            left: The left picture of a rectified pair as cv2.imread gives it: BGR or grey, uint8.
            right: The right one, of the same size.
        """
        pair = StereoPair(left=_rgb_of_bgr(left, "left picture"), right=_rgb_of_bgr(right, "right picture"))
        least_px, most_px = self._least_px, self._least_px + self._count
        options = MatchOptions(range_px=(least_px, most_px), refined=self._refined)
        found = match(self._matcher, pair, options)
        known = ~found.occluded & (found.confidence >= self._min_confidence)
        known &= (found.disparity_px >= least_px) & (found.disparity_px <= most_px)
        steps = np.rint(found.disparity_px * _STEPS_PER_PX)
        return np.where(known, steps, (least_px - 1) * _STEPS_PER_PX).astype(np.int16)

    def getMinDisparity(self) -> int:
        return self._least_px

    def setMinDisparity(self, minDisparity: int) -> None:
        self._least_px = minDisparity
        self._check_range()

    def getNumDisparities(self) -> int:
        return self._count

    def setNumDisparities(self, numDisparities: int) -> None:
        self._count = numDisparities
        self._check_range()

    def _check_range(self) -> None:
        check_whole_number("minDisparity", self._least_px)
        check_whole_number("numDisparities", self._count)
        least_px, most_px = self._least_px, self._least_px + self._count
        # One more at the low end, for what is invalid.
        if self._count < 1 or least_px - 1 < -_LARGEST_PX or most_px > _LARGEST_PX:
            raise StereoweaveError(
                f"expected numDisparities of 1 or more, and disparities of {1 - _LARGEST_PX} to "
                f"{_LARGEST_PX} px, which int16 holds times 16, found minDisparity {least_px} and "
                f"numDisparities {self._count}; stereoweave.estimate gives any as floats"
            )


def _rgb_of_bgr(picture: UInt8[np.ndarray, "h w *channels"], name: str) -> UInt8[np.ndarray, "h w 3"]:
    # Else a PIL image or a tensor, which are RGB, would be taken for BGR.
    if not isinstance(picture, np.ndarray) or picture.dtype != np.uint8:
        raise StereoweaveError(
            f"{name}: expected uint8, BGR [H, W, 3] or grey [H, W], as cv2.imread gives it, "
            f"got {getattr(picture, 'dtype', type(picture).__name__)}"
        )
    return np.ascontiguousarray(as_rgb(picture, name)[..., ::-1])
