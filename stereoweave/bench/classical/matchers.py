"""The classical matchers by name, and the rehearsal that compiles their kernels."""

import numpy as np

from stereoweave.arguments import check_choice
from stereoweave.bench.classical.scanlines import match_scanlines
from stereoweave.bench.classical.spanning_trees import match_spanning_trees
from stereoweave.bench.classical.windows import match_windows
from stereoweave.bench.opencv_matchers import MapMatch
from stereoweave.stereo import StereoPair

CLASSICAL_MATCHERS: dict[str, MapMatch] = {
    "adaptive_window": match_windows,
    "dynamic_programming": match_scanlines,
    "3dmst": match_spanning_trees,
}
"""Classical matchers by name."""


def make_classical_matcher(name: str) -> MapMatch:
    """Return the classical matcher of that name.

    Raises:
        StereoweaveError: There is none of that name.
    """
    check_choice("matchers", name, CLASSICAL_MATCHERS)
    return CLASSICAL_MATCHERS[name]


def rehearse_classical_matchers() -> None:
    """Match a small pair with every matcher, to compile all kernels."""
    image = np.zeros((32, 32, 3), np.uint8)
    image[8:24, 8:24] = 200
    for match in CLASSICAL_MATCHERS.values():
        match(StereoPair(left=image, right=image))
