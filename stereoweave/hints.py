"""What the user of a result should know: that a pair goes beyond the network's range, or hardly is a pair."""

import cv2
import numpy as np
from jaxtyping import Float

from stereoweave.errors import MatcherError
from stereoweave.io import SMALLEST_SIDE_PX
from stereoweave.matcher import Matcher
from stereoweave.stereo import Estimate, StereoPair

_CONFIDENT = 0.5
# At infinity noise goes both ways; farther behind there is something.
_BEHIND_PX = 2.0
# Shares of the picture, between those of sound pairs (15 real, 20 painted) and of others (20 of a kind):
# nearer 0 against at least 8 %; behind at most 6 against at least 42, and 57 where the sides are swapped;
# confident at least 64 against at most 12 of noise, plain pictures and two scenes.
_LEAST_NEARER_PERCENT = 4.0
_LEAST_BEHIND_PERCENT = 12.0
_LEAST_CONFIDENT_PERCENT = 30.0


def hints(pair: StereoPair, estimate: Estimate, matcher: Matcher) -> list[str]:
    """A line for what is amiss with a pair, and its remedy; none for a pair that is sound.

    What lies beyond the range is found by trial: at half the size disparities are half as large, and in a
    mirror they change their sign. Each trial takes a quarter of the estimate's time.
    """
    nearer_px = _at_half_size(pair, matcher)
    mirrored = StereoPair(left=cv2.flip(pair.left, 1), right=cv2.flip(pair.right, 1))
    behind_px = -cv2.flip(_at_half_size(mirrored, matcher), 1)
    return told(estimate, nearer_px, behind_px, matcher.max_disparity_px)


def told(
    estimate: Estimate,
    nearer_px: Float[np.ndarray, "h w"],
    behind_px: Float[np.ndarray, "h w"],
    max_disparity_px: float,
) -> list[str]:
    """The lines of `hints`, from the disparities that its two trials are confident of, NaN elsewhere.

    A trial counts where the estimate is not confident, or is at the end of its range.
    """
    unsure = (estimate.confidence < _CONFIDENT) | (estimate.disparity_px <= 0)
    nearer = unsure & (nearer_px >= max_disparity_px)
    behind = unsure & (behind_px <= -_BEHIND_PX)
    lines = []
    if _percent(nearer) >= _LEAST_NEARER_PERCENT:
        lines.append(
            f"{_percent(nearer):.0f} % of the picture seems nearer than the network's range, 0 to "
            f"{max_disparity_px:g} px: at half the size it is found at up to "
            f"{np.percentile(nearer_px[nearer], 99):.0f} px; match smaller copies of both pictures, "
            "or bring the cameras closer together"
        )
    if _percent(behind) >= _LEAST_BEHIND_PERCENT:
        columns = -np.percentile(behind_px[behind], 1)
        lines.append(
            f"{_percent(behind):.0f} % of the picture seems behind the network's range, 0 to "
            f"{max_disparity_px:g} px: mirrored it is found at down to {-columns:.0f} px; are LEFT and RIGHT "
            f"swapped? If not, cut {columns:.0f} columns off the right of LEFT and off the left of RIGHT"
        )
    confident_percent = _percent(estimate.confidence >= _CONFIDENT)
    if not lines and confident_percent < _LEAST_CONFIDENT_PERCENT:
        lines.append(
            f"sure of only {confident_percent:.0f} % of the picture: it is too plain, or the two do not show "
            "one scene, or not row by row; rectify them, and see that LEFT is the left camera's"
        )
    return lines


def _at_half_size(pair: StereoPair, matcher: Matcher) -> Float[np.ndarray, "h w"]:
    """Disparity in px of the full size, as found at half the size where confident; NaN elsewhere."""
    height, width = pair.left.shape[:2]
    size = (max(width // 2, SMALLEST_SIDE_PX), max(height // 2, SMALLEST_SIDE_PX))
    left, right = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (pair.left, pair.right))
    try:
        found = matcher.estimate(left, right)
    except MatcherError:  # a graph may take pictures of one size alone
        return np.full((height, width), np.nan, np.float32)
    confident_px = np.where(found.confidence >= _CONFIDENT, found.disparity_px, np.float32(np.nan))
    return cv2.resize(
        confident_px * (width / size[0]), (width, height), interpolation=cv2.INTER_NEAREST_EXACT
    )


def _percent(mask: np.ndarray) -> float:
    return 100 * float(mask.mean())
