"""Stereo calibration from pictures of a chessboard or ChArUco board."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from posixpath import splitext
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from stereoweave.cameras.boards import (
    Board,
    PairCorners,
    find_pair_corners,
    glance_at_chessboard,
    shows_chessboard,
)
from stereoweave.cameras.rig import Optics, Rig, Size, format_size
from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.decoding import ENDINGS
from stereoweave.io.images import read_image
from stereoweave.io.side_marks import pair_by_marks
from stereoweave.io.stores import store_at
from stereoweave.system.steps import step

FEWEST_PAIRS = 5
# A pair with an error of more than this many times the median has a misdetected corner or was taken in
# motion.
_OUTLIER = 3.0
# Number of pairs that are looked at before the search, of pictures that must show the same other board, and
# of pictures without any board that suffice.
_GLANCES, _AGREEING_GLANCES, _EMPTY_GLANCES = 6, 3, 8
_GOOD_PX, _FAIR_PX = 0.5, 1.0
_GOOD_COVER_PERCENT, _FAIR_COVER_PERCENT = 60, 40
_GOOD_PAIRS, _GOOD_TILT_DEGREES = 10, 15
# OpenCV 4 keeps the fisheye flags in cv2.fisheye.
_FISHEYE_FLAGS: Any = cv2 if hasattr(cv2, "CALIB_FIX_SKEW") else cv2.fisheye
_ITERATIONS = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-7)


class _Solution(NamedTuple):
    """Result of a calibration.

    Attributes:
        rig: The two cameras.
        turns: Rotation vector of the board in each pair, relative to the left camera.
        errors_px: RMS reprojection error of each pair in the left and the right picture.
    """

    rig: Rig
    turns: list[np.ndarray]
    errors_px: Float[np.ndarray, "pairs 2"]


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A calibrated rig and the quality of its calibration.

    Attributes:
        rig: The two cameras.
        left_error_px, right_error_px: RMS reprojection error in each view.
        epipolar_error_px: Median distance of a right corner from the epipolar line of its left corner.
        cover_percent: Share of the picture that the boards cover, in the view with the smaller share.
        tilt_degrees: Angle between the optical axis and the normal of the most tilted board.
        used: Names of the pairs used.
        left_out: Reason for leaving out each omitted picture or pair, by name.
    """

    rig: Rig
    left_error_px: float
    right_error_px: float
    epipolar_error_px: float
    cover_percent: float
    tilt_degrees: float
    used: tuple[str, ...]
    left_out: Mapping[str, str]

    @property
    def error_px(self) -> float:
        """RMS reprojection error over both views, in px."""
        return float(np.sqrt((self.left_error_px**2 + self.right_error_px**2) / 2))

    @property
    def verdict(self) -> str:
        """Quality in one line: good, fair or poor, with remedies for the faults."""
        faults = list(self._find_faults())
        summary = f"{self.error_px:.2f} px over {len(self.used)} pairs"
        if not faults:
            return f"good: {summary}"
        poor = any(is_poor for is_poor, _ in faults)
        # The faults follow the verdict at once: the error may be small in a poor calibration.
        return f"{'poor' if poor else 'fair'}: {'; '.join(fault for _, fault in faults)} ({summary})"

    def _find_faults(self) -> Iterator[tuple[bool, str]]:
        """Yield for each fault whether it makes the calibration poor, and its description with a remedy."""
        if self.rig.translation_m[0] > 0:
            yield True, "left and right pictures are swapped: rename them"
        if self.error_px > _GOOD_PX:
            yield (
                self.error_px > _FAIR_PX,
                "the reprojection error is large: take sharp pictures of a flat board with both cameras at "
                "the same moment",
            )
        if self.cover_percent < _GOOD_COVER_PERCENT:
            yield (
                self.cover_percent < _FAIR_COVER_PERCENT,
                f"corners cover only {self.cover_percent:.0f} % of the picture: add pictures with the board "
                "near the edges",
            )
        if self.tilt_degrees < _GOOD_TILT_DEGREES:
            yield (
                True,
                f"no board is tilted by {_GOOD_TILT_DEGREES} degrees or more: add pictures of a tilted board",
            )
        if len(self.used) < _GOOD_PAIRS:
            yield False, f"few pairs: use {_GOOD_PAIRS} or more"

    def lines(self) -> list[str]:
        """Return the results as lines for the user."""
        fx, fy = (self.rig.left.matrix[axis, axis] for axis in (0, 1))
        return [
            *(f"{name}: left out, {why}" for name, why in self.left_out.items()),
            f"left camera: focal length {fx:.1f} x {fy:.1f} px, {format_size(self.rig.size_px)} px",
            f"baseline {1000 * self.rig.baseline_m:.2f} mm, cameras rotated by "
            f"{self.rig.rotation_degrees:.2f} degrees relative to each other",
            f"reprojection error {self.error_px:.2f} px (left {self.left_error_px:.2f}, right "
            f"{self.right_error_px:.2f}), epipolar error {self.epipolar_error_px:.2f} px (median)",
            f"boards cover {self.cover_percent:.0f} % of the picture and are tilted by up to "
            f"{self.tilt_degrees:.0f} degrees",
            self.verdict,
        ]


def calibrate(
    folder: str | Path,
    board: Board,
    *,
    fisheye: bool = False,
) -> Calibration:
    """Calibrate a rig from a folder of board pictures.

    Two pictures form a pair if their paths differ only in left vs right, L vs R, or cam0 vs cam1. Examples
    are left/01.png and right/01.png, left01.png and right01.png, and 01_L.png and 01_R.png. A pair is left
    out and reported if a picture is damaged or lacks the board, or if the pair's error exceeds three times
    the median.

    Args:
        folder: Folder with the pictures.
        board: The printed board.
        fisheye: Use the fisheye model of Kannala and Brandt instead of a pinhole with distortion
            k1 k2 p1 p2 k3.

    Raises:
        StereoweaveError: The folder does not exist, it contains fewer than FEWEST_PAIRS usable pairs, or the
            pictures show a chessboard with other numbers of corners.
    """
    pairs, left_out = find_pairs(Path(folder))
    if not board.dictionary:
        _check_board(list(pairs.values()), board)
    seen, size_px = _find_all_corners(pairs, board, left_out)
    _check_enough(len(seen), len(pairs), board, left_out)
    solve = _solve_fisheye if fisheye else _solve_pinhole
    while True:
        try:
            with step("calibrating"):
                solution = solve(board.corners_m(), seen, size_px)
        except cv2.error as error:
            raise StereoweaveError(
                f"{folder}: expected pairs that suffice for a calibration, found {len(seen)} pairs for which "
                f"OpenCV fails ({error.err}); add pictures with the board tilted and near the edges"
            ) from error
        worst_px = solution.errors_px.max(axis=1)
        far = worst_px > _OUTLIER * np.median(worst_px)
        if not far.any():
            rig = replace(solution.rig, name=str(folder))
            return _judge(solution._replace(rig=rig), seen, left_out)
        for index in np.flatnonzero(far):
            off = f"error of {worst_px[index]:.2f} px, more than {_OUTLIER:g} times the median of all pairs"
            left_out[seen[index].name] = off
        seen = [pair for pair, is_far in zip(seen, far, strict=True) if not is_far]
        _check_enough(len(seen), len(pairs), board, left_out)


def _check_board(pairs: Sequence[tuple[Path, Path]], board: Board) -> None:
    """Raise a StereoweaveError if a glance at some pictures shows no board, or one with other corners.

    A search for a board in all pictures would take minutes where there is none, because it tries everything.
    """
    found: Counter[tuple[int, int] | None] = Counter()
    chosen = np.unique(np.linspace(0, len(pairs) - 1, _GLANCES).round().astype(int))
    # The first ones are spread over the folder as well, because a few may suffice.
    paths = [path for index in (*chosen[::2], *chosen[1::2]) for path in pairs[index]]
    image = None
    with step("looking at the pictures", total=len(paths)) as advance:
        for path in paths:
            with suppress(FormatError):
                image = cv2.cvtColor(read_image(path), cv2.COLOR_RGB2GRAY)
                sides = glance_at_chessboard(image, board)
                if sides == board.sides:
                    return
                found[sides] += 1
            advance(1)
            if found[None] == found.total() == _EMPTY_GLANCES:
                break
    looked, empty = found.total(), found.pop(None, 0)
    sides, count = next(iter(found.most_common(1)), (None, 0))
    if sides is not None and count >= _AGREEING_GLANCES and 2 * count > found.total():
        raise StereoweaveError(
            f"expected {board}, found one of {sides[0]}x{sides[1]} in {count} of {len(paths)} pictures; "
            "count the inner corners, where four squares meet",
            setting="board",
        )
    # A board that is too small for a glance is found at full size.
    if image is not None and empty == looked and not shows_chessboard(image, board):
        raise StereoweaveError(
            f"expected {board}, found none in {looked} of {2 * len(pairs)} pictures, spread over the folder; "
            "take sharp pictures with the whole board in both views, and name the marker dictionary of a "
            "ChArUco board",
            setting="board",
        )


def _check_enough(count: int, total: int, board: Board, left_out: Mapping[str, str]) -> None:
    if count >= FEWEST_PAIRS:
        return
    example = next((f" ({name}: {why})" for name, why in left_out.items()), "")
    raise StereoweaveError(
        f"expected {board} in both pictures of at least {FEWEST_PAIRS} pairs, found it in {count} of {total}"
        f"{example}; check the number of corners, or take more pictures with the whole board in both views"
    )


def find_pairs(folder: Path) -> tuple[dict[str, tuple[Path, Path]], dict[str, str]]:
    """Return both pictures of each pair, by name, and the reason why each other picture is left out."""
    if not folder.is_dir():
        raise StereoweaveError(f"{folder}: expected a folder with pictures of a board, found no such folder")
    files = [file.path for file in store_at(folder).files()]
    pictures = [path for path in files if Path(path).suffix.lower() in ENDINGS]
    pairs: dict[str, tuple[str, str]] = {}
    left_out: dict[str, str] = {}
    for pair in pair_by_marks(pictures):
        there = [path for path in pair if path in pictures]
        if len(there) == 1:
            left_out[there[0]] = "the picture of the other camera is missing"
            continue
        used = pairs.setdefault(splitext(pair[0])[0], pair)
        for path, first in zip(pair, used, strict=True):
            if path != first:
                left_out[path] = f"{Path(first).name} is a picture of the same view"
    if not pairs:
        raise StereoweaveError(
            f"{folder}: expected pairs of pictures, such as left/01.png and right/01.png or 01_L.png and "
            f"01_R.png, found none among {len(files)} files"
        )
    return {left: (folder / left, folder / right) for left, right in pairs.values()}, left_out


def _find_all_corners(
    pairs: Mapping[str, tuple[Path, Path]], board: Board, left_out: dict[str, str]
) -> tuple[list[PairCorners], Size]:
    """Find the corners in every pair; return the corners in pairs of the most common size, and that size."""
    seen: list[tuple[PairCorners, Size]] = []
    with step("finding the board", total=len(pairs)) as advance:
        for name, paths in pairs.items():
            try:
                left, right = (cv2.cvtColor(read_image(path), cv2.COLOR_RGB2GRAY) for path in paths)
                seen.append((find_pair_corners(name, left, right, board), (left.shape[1], left.shape[0])))
            except FormatError as error:
                left_out[name] = str(error)
            advance(1)
    if not seen:
        return [], (0, 0)
    size_px = Counter(size for _, size in seen).most_common(1)[0][0]
    for pair, found_px in seen:
        if found_px != size_px:
            left_out[pair.name] = f"size {format_size(found_px)}, but most pairs have {format_size(size_px)}"
    return [pair for pair, found_px in seen if found_px == size_px], size_px


def _solve_pinhole(
    corners_m: Float[np.ndarray, "m 3"], seen: Sequence[PairCorners], size_px: Size
) -> _Solution:
    boards = [corners_m[pair.corners].astype(np.float32) for pair in seen]
    left, right = ([points.astype(np.float32) for points in side] for side in _split_sides(seen))
    start = [
        cv2.calibrateCamera(boards, points, size_px, None, None, criteria=_ITERATIONS)[1:3]
        for points in (left, right)
    ]
    _, k1, d1, k2, d2, rotation, translation, _, _, turns, places, _ = cv2.stereoCalibrateExtended(
        boards, left, right, *start[0], *start[1], size_px, np.eye(3), np.zeros(3),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS, criteria=_ITERATIONS,
    )  # fmt: skip
    lenses = [Optics(matrix=k, distortion=d.ravel()) for k, d in ((k1, d1), (k2, d2))]
    return _measure_solution(
        corners_m, seen, _make_rig(lenses, rotation, translation, size_px), turns, places
    )


def _solve_fisheye(
    corners_m: Float[np.ndarray, "m 3"], seen: Sequence[PairCorners], size_px: Size
) -> _Solution:
    boards = [corners_m[pair.corners].reshape(1, -1, 3) for pair in seen]
    left, right = ([points.reshape(1, -1, 2) for points in side] for side in _split_sides(seen))
    flags = _FISHEYE_FLAGS.CALIB_RECOMPUTE_EXTRINSIC | _FISHEYE_FLAGS.CALIB_FIX_SKEW
    start = [
        cv2.fisheye.calibrate(
            boards, points, size_px, np.zeros((3, 3)), np.zeros(4), flags=flags, criteria=_ITERATIONS
        )[1:3]
        for points in (left, right)
    ]
    # OpenCV's stereo function needs the same number of corners in every pair, so some are repeated.
    most = max(len(pair.corners) for pair in seen)
    again = [np.arange(most) % len(pair.corners) for pair in seen]
    boards, left, right = (
        [points[:, some] for points, some in zip(side, again, strict=True)] for side in (boards, left, right)
    )
    _, k1, d1, k2, d2, rotation, translation, turns, places = cv2.fisheye.stereoCalibrate(
        boards, left, right, *start[0], *start[1], size_px,
        flags=_FISHEYE_FLAGS.CALIB_FIX_SKEW | _FISHEYE_FLAGS.CALIB_USE_INTRINSIC_GUESS, criteria=_ITERATIONS,
    )  # fmt: skip
    lenses = [Optics(matrix=k, distortion=d.ravel(), fisheye=True) for k, d in ((k1, d1), (k2, d2))]
    return _measure_solution(
        corners_m, seen, _make_rig(lenses, rotation, translation, size_px), turns, places
    )


def _split_sides(seen: Sequence[PairCorners]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    return [pair.left_px for pair in seen], [pair.right_px for pair in seen]


def _make_rig(lenses: Sequence[Optics], rotation: np.ndarray, translation: np.ndarray, size_px: Size) -> Rig:
    left, right = lenses
    return Rig(left=left, right=right, rotation=rotation, translation_m=translation.ravel(), size_px=size_px)


def _measure_solution(
    corners_m: Float[np.ndarray, "m 3"],
    seen: Sequence[PairCorners],
    rig: Rig,
    turns: Sequence[np.ndarray],
    places: Sequence[np.ndarray],
) -> _Solution:
    errors_px = np.zeros((len(seen), 2))
    for index, (pair, turn, place) in enumerate(zip(seen, turns, places, strict=True)):
        for_left = corners_m[pair.corners] @ cv2.Rodrigues(turn)[0].T + place.ravel()
        for_right = for_left @ rig.rotation.T + rig.translation_m
        for side, (optics, points_m, at_px) in enumerate(
            ((rig.left, for_left, pair.left_px), (rig.right, for_right, pair.right_px))
        ):
            off_px = _project(optics, points_m) - at_px
            errors_px[index, side] = np.sqrt((off_px**2).sum(axis=1).mean())
    return _Solution(rig, list(turns), errors_px)


def _project(optics: Optics, points_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    project = cv2.fisheye.projectPoints if optics.fisheye else cv2.projectPoints
    args = np.zeros(3), np.zeros(3), optics.matrix, optics.distortion
    return project(points_m.reshape(-1, 1, 3), *args)[0].reshape(-1, 2)


def _judge(solution: _Solution, seen: Sequence[PairCorners], left_out: Mapping[str, str]) -> Calibration:
    rig = solution.rig
    assert rig.size_px is not None
    counts = np.array([len(pair.corners) for pair in seen])
    left_px, right_px = np.sqrt((solution.errors_px**2 * counts[:, None]).sum(axis=0) / counts.sum())
    return Calibration(
        rig=rig,
        left_error_px=float(left_px),
        right_error_px=float(right_px),
        epipolar_error_px=_measure_epipolar_error_px(rig, seen),
        cover_percent=min(_measure_cover_percent(points, rig.size_px) for points in _split_sides(seen)),
        tilt_degrees=max(map(_measure_tilt_degrees, solution.turns)),
        used=tuple(pair.name for pair in seen),
        left_out=left_out,
    )


def _measure_epipolar_error_px(rig: Rig, seen: Sequence[PairCorners]) -> float:
    left, right = (
        _undistort(optics, np.concatenate(points))
        for optics, points in zip((rig.left, rig.right), _split_sides(seen), strict=True)
    )
    # Normal of the epipolar plane through each left direction, in the right camera's coordinates.
    planes = np.cross(rig.translation_m, left @ rig.rotation.T)
    off = np.abs((planes * right).sum(axis=1)) / np.linalg.norm(planes[:, :2], axis=1)
    return float(np.median(off) * np.diag(rig.right.matrix)[:2].mean())


def _undistort(optics: Optics, at_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    undistort = cv2.fisheye.undistortPoints if optics.fisheye else cv2.undistortPoints
    ideal = undistort(at_px.reshape(-1, 1, 2), optics.matrix, optics.distortion).reshape(-1, 2)
    return np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1)


def _measure_cover_percent(views: Sequence[Float[np.ndarray, "_ 2"]], size_px: Size) -> float:
    """Return the percentage of the picture that lies inside the boards' convex hulls."""
    covered = np.zeros(size_px[::-1], np.uint8)
    for at_px in views:
        outline = cv2.convexHull(at_px.astype(np.float32))
        cv2.fillConvexPoly(covered, np.rint(outline).astype(np.int32), 1)
    return float(100 * covered.mean())


def _measure_tilt_degrees(turn: Float[np.ndarray, "..."]) -> float:
    """Return the angle between a board's normal and the optical axis, given the board's rotation vector."""
    return float(np.degrees(np.arccos(np.clip(abs(cv2.Rodrigues(turn)[0][2, 2]), 0, 1))))
