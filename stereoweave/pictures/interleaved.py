"""Layouts of two views whose rows, columns or fields of a checkerboard alternate, and signs of them."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from stereoweave.errors import FormatError, Note
from stereoweave.io.images import SMALLEST_SIDE_PX
from stereoweave.pictures.anaglyphs import MOVED_SHARE, extract_detail, measure_moved_share

# Cubic interpolation between pixels of one view: the nearest ones are 1 px away, the next ones 3 px.
_BETWEEN = np.array([-1, 0, 9, 0, 9, 0, -1], np.float32) / 16
_REACH = len(_BETWEEN) // 2
# At this size, of 12 real pairs 10 are named rightly if interleaved by rows or as a checkerboard, 11 if by
# columns; none of their 24 pictures is suspected (`python -m experiments.interleaved`).
_LONGER_SIDE_PX = 320


@dataclass(frozen=True)
class InterleavedLayout:
    """Layout of two views whose lines alternate; by default the left view has the first one.

    Attributes:
        rows: Whether the rows alternate.
        columns: Whether the columns alternate; rows and columns make a checkerboard.
        right_first: Whether the first pixel belongs to the right view.
    """

    rows: bool = False
    columns: bool = False
    right_first: bool = False

    @property
    def half(self) -> bool:
        """Whether the frame holds only half of the pixels of two views at full size."""
        return True

    def swapped(self) -> "InterleavedLayout":
        """Return the layout with the other view first."""
        return replace(self, right_first=not self.right_first)

    def eye_size_px(self, width_px: int, height_px: int) -> tuple[int, int]:
        """Return the width and height of one view at full size, which are the frame's.

        Raises:
            FormatError: The frame is too small.
        """
        if min(width_px, height_px) < 2 * SMALLEST_SIDE_PX:
            raise FormatError(
                f"expected at least {2 * SMALLEST_SIDE_PX}x{2 * SMALLEST_SIDE_PX} pixels for two interleaved "
                f"views, found {width_px}x{height_px}; give a larger picture"
            )
        return width_px, height_px

    def eyes(
        self, frame: UInt8[np.ndarray, "h w 3"]
    ) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w 3"]]:
        """Return the left and the right view of a frame, each at full size.

        Each view keeps its own pixels where they are; those between are interpolated.
        """
        # Mirrored at its outermost line, a frame continues with lines of the same view as beyond the border.
        between = cv2.filter2D(frame, -1, self._make_kernel(), borderType=cv2.BORDER_REFLECT_101)
        is_first = self._find_first(frame.shape[0], frame.shape[1])[..., None]
        first, second = np.where(is_first, frame, between), np.where(is_first, between, frame)
        return (second, first) if self.right_first else (first, second)

    def note_odd_size(self, width_px: int, height_px: int) -> list[Note]:
        """Return no note, because nothing is dropped from frames of odd width or height."""
        return []

    def _make_kernel(self) -> Float32[np.ndarray, "7 7"]:
        """Return the kernel that interpolates a pixel of the other view from its neighbours."""
        kernel = np.zeros((len(_BETWEEN), len(_BETWEEN)), np.float32)
        if self.rows:
            kernel[:, _REACH] += _BETWEEN
        if self.columns:
            kernel[_REACH] += _BETWEEN
        return kernel / kernel.sum()

    def _find_first(self, height_px: int, width_px: int) -> Bool[np.ndarray, "h w"]:
        """Return which pixels belong to the view that comes first."""
        row, column = np.ogrid[:height_px, :width_px]
        return ((row % 2 == 1) & self.rows) == ((column % 2 == 1) & self.columns)


INTERLEAVED_LAYOUTS = {
    "row_interleaved": InterleavedLayout(rows=True),
    "column_interleaved": InterleavedLayout(columns=True),
    "checkerboard": InterleavedLayout(rows=True, columns=True),
    "row_interleaved_right_first": InterleavedLayout(rows=True, right_first=True),
    "column_interleaved_right_first": InterleavedLayout(columns=True, right_first=True),
    "checkerboard_right_first": InterleavedLayout(rows=True, columns=True, right_first=True),
}


def suspect_interleaving(frame: UInt8[np.ndarray, "h w 3"]) -> str | None:
    """Return the layout, left view first, whose views would be moved against each other; None without one.

    It is no more than a suspicion: a frame of an interlaced television picture in motion looks the same.
    """
    if min(frame.shape[:2]) < 2 * SMALLEST_SIDE_PX:
        return None
    grey = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
    beside, below = (_is_moved(grey[::2, ::2], grey[top::2, left::2]) for top, left in ((0, 1), (1, 0)))
    return {
        (False, True): "row_interleaved",
        (True, False): "column_interleaved",
        (True, True): "checkerboard",
    }.get((beside, below))


def _is_moved(here: UInt8[np.ndarray, "h w"], there: UInt8[np.ndarray, "h2 w2"]) -> bool:
    """Return whether one image is moved horizontally against the other in many places."""
    scale = _LONGER_SIDE_PX / max(here.shape)
    size_px = max(round(here.shape[1] * scale), 1), max(round(here.shape[0] * scale), 1)
    details = [
        extract_detail(cv2.resize(image, size_px, interpolation=cv2.INTER_AREA).astype(np.float32))
        for image in (here, there)
    ]
    return measure_moved_share(*details) > MOVED_SHARE
