"""What the user of a result should know: that the pair is not as it should be, or hardly is a pair."""

import numpy as np

from stereoweave.cameras.alignment import check_pair
from stereoweave.stereo import Estimate, StereoPair

_CONFIDENT = 0.5
# Between the shares of sound pairs (at least 64 %) and of noise and plain pictures (at most 12 %).
_LEAST_CONFIDENT_PERCENT = 30.0


def hints(pair: StereoPair, estimate: Estimate) -> list[str]:
    """A line for what is amiss with a pair, and its remedy; none for a pair that is sound.

    Places that both photographs show are compared (`stereoweave check` says more of them); where there are
    too few, only the confidence of the estimate decides: a plain wall may well be matched.
    """
    alignment = check_pair(pair.left, pair.right)
    if "too_few_matches" not in alignment.defects:
        lines = alignment.warnings()
        if lines:
            return lines
    seen = np.ones(estimate.confidence.shape, bool) if pair.left_seen is None else pair.left_seen
    confident_percent = 100 * float((estimate.confidence >= _CONFIDENT)[seen].mean()) if seen.any() else 0.0
    if confident_percent < _LEAST_CONFIDENT_PERCENT:
        return [
            f"sure of only {confident_percent:.0f} % of the picture: it is too plain, or the two do not show "
            "one scene, or not row by row; --rectify mends rows, and see that LEFT is the left camera's"
        ]
    return []
