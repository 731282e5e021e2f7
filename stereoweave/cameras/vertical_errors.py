"""Model of a pair's vertical errors: shift, rotation, difference in scale and smaller terms."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from stereoweave.cameras.feature_matches import Matches

# Inliers lie within this distance of the fitted field of vertical errors.
_INLIER_PX = 1.5
_FIRST_INLIER_PX = 2.5
_TRIALS, _POLISHING = 400, 6
_LEAST_MATCHES, _LEAST_INLIER_SHARE = 20, 0.2
_SHIFT, _IN_X, _IN_Y = 0, 1, 2


class VerticalErrors(NamedTuple):
    """Vertical errors of the matches that agree with a quadratic function of the position.

    Attributes:
        inliers: Mask of these matches.
        shift_px: Vertical shift of the right picture at its centre.
        slope: Shift in px per px to the right, as a rotation causes.
        growth: Shift in px per px downwards, as a difference in scale causes.
        uneven_px: 95th percentile of the size of all other terms.
    """

    inliers: Bool[np.ndarray, " n"]
    shift_px: float
    slope: float
    growth: float
    uneven_px: float


def fit_vertical_errors(
    matches: Matches, centre_px: Float[np.ndarray, " 2"], scale: float
) -> VerticalErrors | None:
    """Fit the vertical errors of matches, some of which are wrong.

    The errors are modelled as a quadratic function of the position in the right picture. The constant term is
    a shift, the term in x a rotation, and the term in y a difference in scale; pitch and convergence cause
    the other terms.

    Args:
        matches: The matches.
        centre_px: Centre of the right picture.
        scale: Factor for the tolerated distances, above 1 for large pictures.

    Returns:
        The errors; None if no such function explains enough matches.
    """
    x, y = ((matches.right_px - centre_px) / centre_px[0]).T
    terms = np.stack([np.ones_like(x), x, y, x * y, x * x, y * y], axis=1)
    lower_px = matches.lower_px
    inliers = _find_plane_inliers(terms[:, :3], lower_px, scale * _FIRST_INLIER_PX)
    for _ in range(_POLISHING):
        # The ridge limits terms that only a few matches support.
        weights, ridge = terms[inliers], 0.1 * np.eye(6)
        field = np.linalg.solve(weights.T @ weights + ridge, weights.T @ lower_px[inliers])
        inliers = np.abs(terms @ field - lower_px) <= scale * _INLIER_PX
    if inliers.sum() < max(_LEAST_MATCHES, _LEAST_INLIER_SHARE * len(x)):
        return None
    uneven_px = np.abs(terms[inliers, _IN_Y + 1 :] @ field[_IN_Y + 1 :])
    return VerticalErrors(
        inliers=inliers,
        shift_px=float(field[_SHIFT]),
        slope=float(field[_IN_X] / centre_px[0]),
        growth=float(field[_IN_Y] / centre_px[0]),
        uneven_px=float(np.percentile(uneven_px, 95)),
    )


def _find_plane_inliers(
    terms: Float[np.ndarray, "n 3"], values: Float[np.ndarray, " n"], tolerated: float
) -> Bool[np.ndarray, " n"]:
    """Return the inliers of the best plane found by RANSAC; the zero plane is one of the candidates."""
    rng = np.random.default_rng(0)
    picked = rng.integers(0, len(values), (_TRIALS, 3))
    through = terms[picked]
    picked, through = (array[np.abs(np.linalg.det(through)) > 0.01] for array in (picked, through))
    planes = np.linalg.solve(through, values[picked][..., None])[..., 0]
    planes = np.concatenate([np.zeros((1, 3)), planes])
    missed = np.minimum(np.abs(planes @ terms.T - values), tolerated)
    best = missed.sum(1).argmin()
    return missed[best] < tolerated
