"""Plain reference of `edge_vote.vote_kernels`, pixel by pixel."""

import numpy as np


def plain_vote(lab, disparity_px, confidence, sound):
    """Return the disparities [H, W] after one round, the agreement (else NaN), and what stays unsound."""
    voted_px, agreement, unsound = disparity_px.copy(), np.full(sound.shape, np.nan), ~sound
    height, width = disparity_px.shape
    for y, x in np.argwhere(~sound):
        rows, columns = np.mgrid[max(y - 4, 0) : min(y + 5, height), max(x - 4, 0) : min(x + 5, width)]
        away = (rows - y) ** 2 + (columns - x) ** 2
        unlike = ((lab[rows, columns] - lab[y, x]) ** 2).sum(-1)
        alike = np.exp(-away / (2 * 2.5**2) - unlike / (2 * 6.0**2))
        weights = alike * (confidence[rows, columns] + 0.05)
        voting = sound[rows, columns] & (weights >= 1e-6)
        if voting.any():
            order = np.argsort(disparity_px[rows, columns][voting], kind="stable")
            below = np.cumsum(weights[voting][order])
            middle = np.searchsorted(below, below[-1] / 2)
            voted_px[y, x] = disparity_px[rows, columns][voting][order][middle]
            unsound[y, x] = False
            agreed = np.abs(disparity_px[rows, columns] - voted_px[y, x]) <= 1
            believed = (alike * confidence[rows, columns])[voting & agreed].sum()
            agreement[y, x] = believed / alike[voting].sum()
    return voted_px, agreement, unsound
