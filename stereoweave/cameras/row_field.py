"""Smooth field of vertical moves, which aligns the rows that a rectification leaves apart."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

# Number of cosines along each axis.
_COSINES = 5
# Standard deviation of the constant term in px. That of the other terms falls with their frequency.
_LIKELY_PX = 5.0
# Scale of the robust loss, and number of times that its weights are computed.
_SOFT_PX = 0.5
_STEPS = 20
# Number of fixed-point steps of `align`; each one multiplies the error by the field's slope.
_ALIGN_STEPS = 8


@dataclass(frozen=True, kw_only=True)
class RowField:
    """Field of vertical errors in px: a sum of cosines of low frequency.

    Rolling shutters, warped prints and unusual lenses cause such errors.

    Attributes:
        terms_px: Coefficients; cosines along y in rows, along x in columns.
        size_px: Width and height of the picture.
    """

    terms_px: Float[np.ndarray, "k k"]
    size_px: tuple[int, int]

    def measure_lower_px(self, places_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Return how much lower the picture's content is at these places than it must be."""
        along_x, along_y = _list_cosines(places_px, self.size_px)
        return ((along_y @ self.terms_px) * along_x).sum(1)

    def measure_everywhere_px(self) -> Float[np.ndarray, "h w"]:
        """Return the field at every pixel, as float32."""
        along_x, along_y = (_list_cosines_of(np.arange(side), side) for side in self.size_px)
        return ((along_y @ self.terms_px) @ along_x.T).astype(np.float32)

    def align(self, places_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Return where points of the picture are after their rows have been aligned."""
        aligned_px = places_px.copy()
        for _ in range(_ALIGN_STEPS):
            aligned_px[:, 1] = places_px[:, 1] - self.measure_lower_px(aligned_px)
        return aligned_px


def fit_row_field(
    places_px: Float[np.ndarray, "n 2"], lower_px: Float[np.ndarray, " n"], size_px: tuple[int, int]
) -> RowField:
    """Fit a field robustly to the vertical errors of matches.

    Args:
        places_px: Places in the right picture where the matches must be: the column of the right picture, and
            the row of the left one.
        lower_px: How much lower the matches are in the right picture.
        size_px: Width and height of the picture.
    """
    along_x, along_y = _list_cosines(places_px, size_px)
    terms = (along_y[:, :, None] * along_x[:, None, :]).reshape(len(places_px), -1)
    order = np.arange(_COSINES)
    frequency = (order[:, None] ** 2 + order**2).ravel()
    prior = np.diag((1 + frequency) ** 2 * (_SOFT_PX / _LIKELY_PX) ** 2)
    found, weights = np.zeros(_COSINES**2), np.ones(len(places_px))
    for _ in range(_STEPS):
        weighted = terms * weights[:, None]
        found = np.linalg.solve(weighted.T @ terms + prior, weighted.T @ lower_px)
        weights = 1 / (1 + ((terms @ found - lower_px) / _SOFT_PX) ** 2)
    return RowField(terms_px=found.reshape(_COSINES, _COSINES), size_px=size_px)


def _list_cosines(
    places_px: Float[np.ndarray, "n 2"], size_px: tuple[int, int]
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n k"]]:
    """Return the cosines along x and along y at these places."""
    along_x, along_y = (
        _list_cosines_of(places, side) for places, side in zip(places_px.T, size_px, strict=True)
    )
    return along_x, along_y


def _list_cosines_of(places_px: np.ndarray, side_px: int) -> Float[np.ndarray, "n k"]:
    return np.cos(np.pi * (places_px[:, None] + 0.5) / side_px * np.arange(_COSINES))
