"""Numba kernel of `vote`; the plain reference is tests/helpers/plain_voting.py."""

import typing

import numpy as np

from stereoweave.system.jit import inlined, kernel

RADIUS_PX = 4
"""Neighbours up to this far away, along each axis, vote."""
AWAY_PX, UNLIKE_LEVELS = np.float32(2.5), np.float32(6.0)
"""Standard deviations of the distance and of the difference in colour (CIELAB) at which weights fall."""
LEAST_CONFIDENCE = np.float32(0.05)
"""Added to each confidence, so that neighbours of no confidence decide where there are no others."""
LEAST_WEIGHT = np.float32(1e-6)
"""Neighbours below this weight do not vote."""
SAME_PX = np.float32(1.0)
"""Neighbours within this of the median agree with it."""
_FARTHEST_PX = np.float32(3e38)  # no disparity is farther from 0


@kernel
@typing.no_type_check
def vote(lab, before_px, confidence, sound, voted_px, agreement, unsound, first, end):
    """Write the weighted medians of the sound disparities around the other pixels of rows first..end.

    These pixels are removed from `unsound`. A pixel without a vote stays as it is. The agreement with a
    median is the mean over all neighbours that vote, weighted by distance and colour, of the confidence of
    those that agree and 0 for the others.

    Args:
        lab: float32 [H, W, 3], colours in CIELAB.
        before_px: float32 [H, W], disparities that vote.
        confidence: float32 [H, W].
        sound: bool [H, W], mask of the pixels that vote.
        voted_px: float32 [H, W], disparities to replace.
        agreement: float32 [H, W], receives the neighbours' agreement with each disparity that is replaced.
        unsound: bool [H, W], mask from which replaced pixels are removed.
        first: First row.
        end: Row after the last.
    """
    height, width = before_px.shape
    # Of each neighbour that votes: disparity, weight, and weight without confidence.
    ballots = np.empty((3, (2 * RADIUS_PX + 1) ** 2), np.float32)
    for y in range(first, end):
        for x in range(width):
            if sound[y, x]:
                continue
            count, total = 0, np.float32(0)
            for v in range(max(y - RADIUS_PX, 0), min(y + RADIUS_PX + 1, height)):
                for u in range(max(x - RADIUS_PX, 0), min(x + RADIUS_PX + 1, width)):
                    if not sound[v, u]:
                        continue
                    alike = _weigh(lab, y, x, v, u)
                    weight = alike * (confidence[v, u] + LEAST_CONFIDENCE)
                    if weight >= LEAST_WEIGHT:
                        ballots[0, count] = before_px[v, u]
                        ballots[1, count], ballots[2, count] = weight, alike
                        count, total = count + 1, total + weight
            if count > 0:
                voted_px[y, x], unsound[y, x] = _find_median(ballots, count, total), False
                agreement[y, x] = _measure_agreement(ballots, count, voted_px[y, x])


@inlined
@typing.no_type_check
def _weigh(lab, y, x, v, u):
    """Return the weight of the neighbour (v, u) by distance and colour."""
    away = np.float32((v - y) * (v - y) + (u - x) * (u - x)) / (np.float32(2) * AWAY_PX * AWAY_PX)
    unlike = np.float32(0)
    for channel in range(3):
        unlike += (lab[v, u, channel] - lab[y, x, channel]) ** 2
    return np.exp(-away - unlike / (np.float32(2) * UNLIKE_LEVELS * UNLIKE_LEVELS))


@inlined
@typing.no_type_check
def _find_median(ballots, count, total):
    """Return the least disparity up to which the weights sum to half of the total.

    Each disparity between the known bounds becomes a bound itself, so few are compared with all others.
    """
    below, median = -_FARTHEST_PX, _FARTHEST_PX
    for i in range(count):
        px = ballots[0, i]
        if below < px < median:
            if _sum_up_to(ballots, count, px) >= total / np.float32(2):
                median = px
            else:
                below = px
    return median


@inlined
@typing.no_type_check
def _sum_up_to(ballots, count, px):
    """Return the sum of the weights of all disparities up to one of them."""
    total = np.float32(0)
    for i in range(count):
        total += ballots[1, i] if ballots[0, i] <= px else np.float32(0)
    return total


@inlined
@typing.no_type_check
def _measure_agreement(ballots, count, median):
    """Return the share of the neighbours that agree with the median, each times its confidence."""
    agreeing, total = np.float32(0), np.float32(0)
    for i in range(count):
        total += ballots[2, i]
        if abs(ballots[0, i] - median) <= SAME_PX:
            agreeing += ballots[1, i] - LEAST_CONFIDENCE * ballots[2, i]
    return agreeing / total
