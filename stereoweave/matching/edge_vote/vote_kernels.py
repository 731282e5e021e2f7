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
    ballots = np.empty(((2 * RADIUS_PX + 1) ** 2, 3), np.float32)
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
                        _insert(ballots, count, before_px[v, u], weight, alike)
                        count, total = count + 1, total + weight
            if count > 0:
                voted_px[y, x], unsound[y, x] = _find_median(ballots, total), False
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
def _insert(ballots, count, value, weight, alike):
    """Insert a disparity and its weight, with and without confidence, into the first `count` ballots.

    The ballots remain in ascending order of disparity.
    """
    at = count
    while at > 0 and ballots[at - 1, 0] > value:
        for column in range(3):
            ballots[at, column] = ballots[at - 1, column]
        at -= 1
    ballots[at, 0], ballots[at, 1], ballots[at, 2] = value, weight, alike


@inlined
@typing.no_type_check
def _find_median(ballots, total):
    """Return the first disparity at which the sum of the weights reaches half of the total."""
    at, below = 0, ballots[0, 1]
    while below < total / np.float32(2):
        at += 1
        below += ballots[at, 1]
    return ballots[at, 0]


@inlined
@typing.no_type_check
def _measure_agreement(ballots, count, median):
    """Return the share of the neighbours that agree with the median, each times its confidence."""
    agreeing, total = np.float32(0), np.float32(0)
    for i in range(count):
        total += ballots[i, 2]
        if abs(ballots[i, 0] - median) <= SAME_PX:
            agreeing += ballots[i, 1] - LEAST_CONFIDENCE * ballots[i, 2]
    return agreeing / total
