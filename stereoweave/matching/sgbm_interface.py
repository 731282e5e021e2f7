"""Drop-in replacement for OpenCV's StereoSGBM that runs the shipped networks."""

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
    """Replacement for cv2.StereoSGBM; `compute` returns int16 disparities in 1/16 px.

    minDisparity and numDisparities have the same meaning as in OpenCV. Parameters of OpenCV's
    algorithm (blockSize, P1, P2, disp12MaxDiff, preFilterCap, uniquenessRatio, speckleWindowSize,
    speckleRange and mode) do not apply to a network and raise a TypeError.

    Args:
        minDisparity: Least disparity in px; negative for converged cameras.
        numDisparities: Number of disparities from minDisparity; unlike in OpenCV, it need not be a multiple
            of 16.
        model: Name of a shipped network, or path of an .onnx matcher file.
        threads: Maximum number of threads per call; default: all cores.
        provider: See `stereoweave.estimate`.
        refined: See `stereoweave.estimate`.
        min_confidence: Least confidence of a valid pixel.
    """

    def __init__(  # noqa: PLR0913 - two of OpenCV's parameters, and a matcher's
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
            raise StereoweaveError(
                f"min_confidence: expected a probability from 0 to 1, found {min_confidence}"
            )
        self._check_range()
        self._matcher = Backend(model=model, threads=threads, provider=provider).matcher()

    def compute(
        self, left: UInt8[np.ndarray, "h w *channels"], right: UInt8[np.ndarray, "h w *channels"]
    ) -> Int16[np.ndarray, "h w"]:
        """Return the left image's disparity in 1/16 px; invalid pixels are (minDisparity - 1) * 16.

        A pixel is invalid if it is occluded, if its confidence is below min_confidence, or if its disparity
        is outside minDisparity to minDisparity + numDisparities.

        Args:
            left: Left image of a rectified pair, as returned by cv2.imread: BGR or grey, uint8.
            right: Right image of the same size.
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
        # The value below minDisparity marks invalid pixels.
        if self._count < 1 or least_px - 1 < -_LARGEST_PX or most_px > _LARGEST_PX:
            raise StereoweaveError(
                f"expected numDisparities of at least 1 and disparities from {1 - _LARGEST_PX} to "
                f"{_LARGEST_PX} px, which fit in int16 in units of 1/16 px, found minDisparity {least_px} "
                f"and numDisparities {self._count}; use stereoweave.estimate, which returns floats"
            )


def _rgb_of_bgr(picture: UInt8[np.ndarray, "h w *channels"], name: str) -> UInt8[np.ndarray, "h w 3"]:
    # PIL images and tensors are RGB and would be misread as BGR.
    if not isinstance(picture, np.ndarray) or picture.dtype != np.uint8:
        raise StereoweaveError(
            f"{name}: expected a uint8 array, BGR [H, W, 3] or grey [H, W], as returned by cv2.imread, "
            f"got {getattr(picture, 'dtype', type(picture).__name__)}"
        )
    return np.ascontiguousarray(as_rgb(picture, name)[..., ::-1])
