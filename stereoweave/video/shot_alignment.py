"""Alignment of a video: one rectification for each shot."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from stereoweave.cameras.auto_align import align_rows, swap
from stereoweave.cameras.camera_fit import Warps
from stereoweave.cameras.picture_warp import PictureWarp
from stereoweave.cameras.rectify_uncalibrated import apply_warps
from stereoweave.cameras.row_field import RowField
from stereoweave.stereo import StereoPair
from stereoweave.video.reader import FinePair


class ShotAligner:
    """Aligner of a video's frames, which measures the rows once a shot.

    If the first frames of a shot are too plain to be measured, a later one is.

    Args:
        swapped: Whether left and right are swapped in the whole video.

    Attributes:
        has_warped: Whether any frame was warped, so that the camera of the frames as read no longer holds.
    """

    def __init__(self, *, swapped: bool = False) -> None:
        self.has_warped = False
        self._swapped, self._measured = swapped, False
        self._warps: Warps | None = None

    def __call__(self, pair: StereoPair) -> StereoPair:
        """Return the aligned frame of the current shot."""
        pair = swap(pair) if self._swapped else pair
        if not self._measured:
            aligned = align_rows(pair, keep_screen=True)
            self._measured, self._warps = aligned.alignment.is_known, aligned.warps
        if not self._warps:
            return pair
        self.has_warped = True
        return _warp(pair, self._warps)

    def align_fine(self) -> Callable[[FinePair], FinePair]:
        """Return the change that the last frame underwent, for its fine pictures."""
        swapped, warps = self._swapped, self._warps

        def change(pair: FinePair) -> FinePair:
            left, right = pair[::-1] if swapped else pair
            if not warps:
                return left, right
            return warps.left.apply(left, None)[0], warps.right.apply(right, None)[0]

        return change

    def begin_shot(self) -> None:
        """Measure the next frame."""
        self._measured, self._warps = False, None

    def state(self) -> dict[str, np.ndarray]:
        """Return the complete state as arrays; a restored aligner gives the same results."""
        kept = {"aligner": np.array([self._swapped, self._measured, self.has_warped])}
        for side in Warps._fields if self._warps else ():
            warp: PictureWarp = getattr(self._warps, side)
            kept[f"{side}_homography"] = warp.homography
            kept[f"{side}_lens"] = np.array([warp.distortion, *warp.size_px])
            if warp.field:
                kept[f"{side}_field_px"] = warp.field.terms_px
        return kept

    @classmethod
    def from_state(cls, state: Mapping[str, np.ndarray]) -> "ShotAligner":
        """Restore an aligner from a saved `state`."""
        swapped, measured, has_warped = state["aligner"].tolist()
        aligner = cls(swapped=swapped)
        aligner._measured, aligner.has_warped = measured, has_warped
        if "left_homography" in state:
            aligner._warps = Warps(*(_restore_warp(state, side) for side in Warps._fields))
        return aligner


def _warp(pair: StereoPair, warps: Warps) -> StereoPair:
    """Warp a frame. Borders repeat the picture's and count as content, so that frames keep their size."""
    return replace(apply_warps(pair, warps), left_seen=None, right_seen=None)


def _restore_warp(state: Mapping[str, np.ndarray], side: str) -> PictureWarp:
    distortion, width, height = state[f"{side}_lens"].tolist()
    size_px = int(width), int(height)
    terms_px = state.get(f"{side}_field_px")
    return PictureWarp(
        homography=state[f"{side}_homography"],
        distortion=distortion,
        size_px=size_px,
        field=None if terms_px is None else RowField(terms_px=terms_px, size_px=size_px),
    )
