"""Calibration boards and detection of their corners."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from stereoweave.arguments import suggest
from stereoweave.cameras.rig import format_size
from stereoweave.errors import FormatError, StereoweaveError

_FEWEST_CORNERS = 8
# A board is sought in a copy of at most this many pixels, because a search of a large picture takes seconds.
_SEARCHED_PX = 1_000_000
# Another board than the printed one has at least this many corners a side, since parts of other patterns look
# like smaller ones.
_GLANCE_CORNERS = 4


@dataclass(frozen=True, kw_only=True)
class Board:
    """A printed chessboard, or a ChArUco board if `dictionary` is given.

    Attributes:
        columns, rows: Size of the board, counted as in OpenCV: in inner corners (where four squares meet)
            for a chessboard, in squares for a ChArUco board.
        square_m: Side length of a square.
        marker_m: Side length of a marker on a ChArUco board.
        dictionary: OpenCV's name for the marker dictionary, such as DICT_5X5_100.
    """

    columns: int
    rows: int
    square_m: float
    marker_m: float | None = None
    dictionary: str | None = None

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or not self.square_m > 0:
            raise StereoweaveError(
                "expected a board of at least 3x3 with squares larger than 0 mm, "
                f"found {self.columns}x{self.rows} with squares of {1000 * self.square_m:g} mm"
            )
        if (self.marker_m is None) != (self.dictionary is None):
            raise StereoweaveError(
                "expected both the dictionary and the size of a ChArUco board's markers, "
                "found only one of them"
            )
        if self.marker_m is not None and not 0 < self.marker_m < self.square_m:
            raise StereoweaveError(
                f"expected markers smaller than the squares ({1000 * self.square_m:g} mm), "
                f"found markers of {1000 * self.marker_m:g} mm"
            )
        names = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
        if self.dictionary is not None and self.dictionary not in names:
            raise StereoweaveError(
                f"unknown marker dictionary {self.dictionary}; expected one of {', '.join(names)}"
                + suggest(self.dictionary, names)
            )

    def __str__(self) -> str:
        if self.dictionary:
            return f"a ChArUco board of {self.columns}x{self.rows} squares ({self.dictionary})"
        return f"a chessboard of {self.columns}x{self.rows} inner corners"

    @property
    def sides(self) -> tuple[int, int]:
        """Columns and rows, the more numerous first."""
        return max(self.columns, self.rows), min(self.columns, self.rows)

    def charuco(self) -> cv2.aruco.CharucoBoard:
        """Return the ChArUco board as an OpenCV object."""
        assert self.marker_m is not None
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, str(self.dictionary)))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_m, self.marker_m, markers)

    def corners_m(self) -> Float[np.ndarray, "n 3"]:
        """Return the corner positions on the board in metres, row by row."""
        if self.dictionary:
            return np.array(self.charuco().getChessboardCorners(), np.float64)
        down, across = np.mgrid[: self.rows, : self.columns].reshape(2, -1)
        return np.stack([across, down, 0 * down], axis=-1) * self.square_m


class PairCorners(NamedTuple):
    """Corners visible in both pictures of a pair: their indices on the board, and x and y in px."""

    name: str
    corners: Int[np.ndarray, " n"]
    left_px: Float[np.ndarray, "n 2"]
    right_px: Float[np.ndarray, "n 2"]


class ViewCorners(NamedTuple):
    """Corners in one view: their indices on the board, and x and y in px."""

    corners: Int[np.ndarray, " n"]
    at_px: Float[np.ndarray, "n 2"]


def find_pair_corners(
    name: str, left: UInt8[np.ndarray, "h w"], right: UInt8[np.ndarray, "h2 w2"], board: Board
) -> PairCorners:
    """Find the corners visible in both pictures.

    Raises:
        FormatError: The pictures differ in size, or too few corners are visible in both.
    """
    if left.shape != right.shape:
        sizes = [format_size(image.shape[::-1]) for image in (left, right)]
        raise FormatError(f"the left picture has {sizes[0]} pixels, but the right one has {sizes[1]}")
    find = _find_charuco if board.dictionary else _find_chessboard
    found = [find(image, board) for image in (left, right)]
    nowhere = [side for side, corners in zip(("left", "right"), found, strict=True) if corners is None]
    if nowhere:
        raise FormatError(f"no board was detected in the {' and the '.join(nowhere)} picture")
    here, there = found
    assert here is not None and there is not None
    if not board.dictionary:
        there = reorder_corners(here, there, board)
    both, in_left, in_right = np.intersect1d(here.corners, there.corners, return_indices=True)
    places = board.corners_m()[both]
    if len(both) < _FEWEST_CORNERS or np.linalg.matrix_rank(places - places.mean(axis=0)) < 2:
        raise FormatError(f"only {len(both)} corners of the board are visible in both pictures")
    return PairCorners(name, both, here.at_px[in_left], there.at_px[in_right])


def glance_at_chessboard(image: UInt8[np.ndarray, "h w"], board: Board) -> tuple[int, int] | None:
    """Return the columns and rows of the chessboard that a picture seems to show, the more numerous first.

    This takes less time than `find_pair_corners` and may miss a small board. None if no board is found.
    """
    small, _ = _scale_down(image)
    # A smaller board than the printed one is found as a part of it, so the printed one is sought first. Only
    # it is sought exhaustively: a part of another pattern must not look like a board.
    printed = (board.columns, board.rows), cv2.CALIB_CB_EXHAUSTIVE
    for least, more in (printed, ((_GLANCE_CORNERS, _GLANCE_CORNERS), 0)):
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER | more
        found, _, marks = cv2.findChessboardCornersSBWithMeta(small, least, flags)
        if found:
            return max(marks.shape), min(marks.shape)
    return None


def shows_chessboard(image: UInt8[np.ndarray, "h w"], board: Board) -> bool:
    """Return whether a chessboard is found at full size, by a search that is not exhaustive."""
    found, _ = cv2.findChessboardCornersSB(
        image, (board.columns, board.rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE
    )
    return bool(found)


def _find_chessboard(image: UInt8[np.ndarray, "h w"], board: Board) -> ViewCorners | None:
    """Find the corners in a small copy of the picture, then precisely in the part of it around them."""
    small, scale = _scale_down(image)
    at_px = _search(small, board, cv2.CALIB_CB_ACCURACY)
    if scale < 1:
        if at_px is None:  # the board may be too small for the copy
            at_px, scale = _search(image, board), 1.0
        if at_px is None:
            return None
        precise_px = _find_precisely(image, at_px / scale, board)
        at_px = _search(image, board, cv2.CALIB_CB_ACCURACY) if precise_px is None else precise_px
    return None if at_px is None else ViewCorners(np.arange(board.columns * board.rows), at_px)


def _search(image: UInt8[np.ndarray, "h w"], board: Board, flags: int = 0) -> Float[np.ndarray, "n 2"] | None:
    """Return the places of all corners of a chessboard; None if they are not found."""
    for more in (0, cv2.CALIB_CB_EXHAUSTIVE):
        found, at_px = cv2.findChessboardCornersSB(
            image, (board.columns, board.rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE | flags | more
        )
        if found:
            return at_px.reshape(-1, 2).astype(np.float64)
    return None


def _find_precisely(
    image: UInt8[np.ndarray, "h w"], near_px: Float[np.ndarray, "n 2"], board: Board
) -> Float[np.ndarray, "n 2"] | None:
    """Find the corners of a chessboard to a fraction of a pixel, given where they are about."""
    # The outer squares lie around the corners; the farther ones of a tilted board are smaller.
    margin_px = 2 * np.ptp(near_px, axis=0).max() / (min(board.columns, board.rows) - 1)
    left, top = np.maximum(near_px.min(axis=0) - margin_px, 0).astype(int)
    right, bottom = np.ceil(near_px.max(axis=0) + margin_px).astype(int)
    part = np.ascontiguousarray(image[top:bottom, left:right])
    at_px = _search(part, board, cv2.CALIB_CB_ACCURACY)
    return None if at_px is None else at_px + (left, top)


def _scale_down(image: UInt8[np.ndarray, "h w"]) -> tuple[UInt8[np.ndarray, "h2 w2"], float]:
    """Return the picture at a size that is soon searched, and that size divided by the picture's."""
    scale = min(1.0, float(np.sqrt(_SEARCHED_PX / image.size)))
    if scale == 1.0:
        return image, scale
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), scale


def _find_charuco(image: UInt8[np.ndarray, "h w"], board: Board) -> ViewCorners | None:
    at_px, corners, _, _ = cv2.aruco.CharucoDetector(board.charuco()).detectBoard(image)
    if corners is None or not len(corners):
        return None
    return ViewCorners(corners.ravel().astype(int), at_px.reshape(-1, 2).astype(np.float64))


def reorder_corners(here: ViewCorners, there: ViewCorners, board: Board) -> ViewCorners:
    """Reorder the right corners to match the left ones, because a chessboard has no orientation mark."""
    grid = there.at_px.reshape(board.rows, board.columns, 2)
    turns = (0, 1, 2, 3) if board.rows == board.columns else (0, 2)
    orders = [np.rot90(grid, turn).reshape(-1, 2) for turn in turns]
    wanted = here.at_px - here.at_px.mean(axis=0)
    unlike = [np.abs(order - order.mean(axis=0) - wanted).sum() for order in orders]
    return ViewCorners(here.corners, orders[int(np.argmin(unlike))])
