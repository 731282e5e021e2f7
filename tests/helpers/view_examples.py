"""Shared by the tests of new views: a pair whose views are easily computed by hand."""

import numpy as np

from stereoweave.data.samples import make_sample
from stereoweave.stereo import Sample, StereoPair

WALL_PX, BOX_PX = 2, 8


def boxes_before_a_wall(*boxes: tuple[int, int], width: int = 40, height: int = 3) -> Sample:
    """Return a sample with boxes of disparity 8 in these left columns, before a wall of disparity 2."""
    left_px, right_px = (np.full((height, width), WALL_PX, np.float32) for _ in range(2))
    for start, end in boxes:
        left_px[:, start:end] = BOX_PX
        right_px[:, start - BOX_PX : end - BOX_PX] = BOX_PX
    grey = np.full((height, width, 3), 100, np.uint8)
    return make_sample(StereoPair(left=grey, right=grey), left_px, right_px)
