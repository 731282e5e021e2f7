"""Direction of a pair's baseline, by the direction in which depth moves its matches."""

import numpy as np
from jaxtyping import Float

from stereoweave.cameras.feature_matches import Matches
from stereoweave.errors import Note, Remedy

STACKED = Note(
    "depth moves things up and down instead of sideways: one camera stood above the other, or both pictures "
    "are turned",
    Remedy("rotate both pictures by 90 degrees"),
)
# On 12 rectified pairs, parallax across the rows is at most 0.06 of that along them.
_CLEARLY = 3.0
_LEAST_PARALLAX_PX = 1.0
# Share of the matches that a plane is fitted to, and the number of fits; the others may be wrong.
_FITTED, _FITS = 0.8, 5
_QUANTILE = 0.75


def has_vertical_baseline(found: Matches, scale: float) -> bool:
    """Return whether parallax is clearly larger across the rows than along them.

    Args:
        found: The pair's matches.
        scale: Factor by which tolerances in px grow with the pictures.
    """
    along_px, across_px = (_measure_parallax(found, px) for px in (found.disparity_px, found.lower_px))
    return across_px > max(_CLEARLY * along_px, scale * _LEAST_PARALLAX_PX)


def _measure_parallax(found: Matches, offsets_px: Float[np.ndarray, " n"]) -> float:
    """Return how much the offsets vary about their best plane.

    The plane removes what a shift, a rotation, a difference in scale and a slanted scene cause.
    """
    places = np.column_stack([found.left_px, np.ones(len(offsets_px))])
    kept = np.ones(len(offsets_px), bool)
    for _ in range(_FITS):
        plane = np.linalg.lstsq(places[kept], offsets_px[kept], rcond=None)[0]
        apart_px = np.abs(offsets_px - places @ plane)
        kept = apart_px <= np.quantile(apart_px, _FITTED)
    return float(np.quantile(apart_px, _QUANTILE))
