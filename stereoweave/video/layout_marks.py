"""Marks of a film of a layout, from what is known about the cameras of its views."""

from math import atan, degrees
from typing import NamedTuple

from stereoweave.stereo import StereoCamera
from stereoweave.video.mp4_marks import MOST_BASELINE_M, VideoMarks
from stereoweave.video.writer import Packing


class LayoutPacking(NamedTuple):
    """How a layout holds one view for each eye: as `VideoMarks` say it, and as its stream declares it."""

    packing: str
    right_first: bool
    declared: Packing


_BESIDE = LayoutPacking("side_by_side", False, Packing("left_right", 3))
_ABOVE = LayoutPacking("top_bottom", False, Packing("top_bottom", 4))
PACKED = {
    "side_by_side": _BESIDE,
    "side_by_side_half": _BESIDE,
    "crossed": LayoutPacking("side_by_side", True, Packing("right_left", None)),
    "top_bottom": _ABOVE,
    "top_bottom_half": _ABOVE,
}


def find_baseline_m(
    baseline_m: float | None, *, strength: float, convergence_px: float, fitted: bool
) -> float | None:
    """Return the distance of the cameras of new views; None if unknown, or if it would give no depth.

    Args:
        baseline_m: Distance of the cameras of the video; None if it is unknown.
        strength: Factor by which it was multiplied.
        convergence_px: Disparity that the views were shifted by.
        fitted: Whether both were chosen for a screen instead, frame by frame.
    """
    if baseline_m is None or convergence_px or fitted:
        return None
    scaled_m = strength * baseline_m
    return scaled_m if 0 < scaled_m <= MOST_BASELINE_M else None


def mark_layout(
    layout: str | None, camera: StereoCamera | None, width_px: int, baseline_m: float | None
) -> VideoMarks | None:
    """Return the marks of a layout; None for one that does not hold one view for each eye.

    Args:
        layout: A name in `LAYOUTS`.
        camera: Camera of the views; None if it is unknown.
        width_px: Width of a view at the camera's scale.
        baseline_m: Distance of the cameras of the new views (`find_baseline_m`).
    """
    if layout not in PACKED:
        return None
    packing, right_first, _ = PACKED[layout]
    if camera is None:
        return VideoMarks(packing=packing, right_first=right_first)
    return VideoMarks(
        packing=packing,
        right_first=right_first,
        field_of_view_deg=degrees(2 * atan(width_px / (2 * camera.focal_px))),
        baseline_m=baseline_m,
    )
