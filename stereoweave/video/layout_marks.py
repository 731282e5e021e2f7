"""Marks of a film of a layout, from what is known about the cameras of its views."""

from math import atan, degrees

from stereoweave.stereo import StereoCamera
from stereoweave.video.mp4_marks import VideoMarks

# The packing of each layout with one view for each eye, and whether the right view comes first.
PACKED = {
    "side_by_side": ("side_by_side", False),
    "side_by_side_half": ("side_by_side", False),
    "crossed": ("side_by_side", True),
    "top_bottom": ("top_bottom", False),
    "top_bottom_half": ("top_bottom", False),
}


def mark_layout(
    layout: str | None, camera: StereoCamera | None, width_px: int, *, strength: float, convergence_px: float
) -> VideoMarks | None:
    """Return the marks of a layout; None for one that does not hold one view for each eye.

    Args:
        layout: A name in `LAYOUTS`.
        camera: Camera of the views; None if it is unknown.
        width_px: Width of a view at the camera's scale.
        strength: Factor by which the baseline was multiplied.
        convergence_px: Disparity that the views were shifted by. The baseline is then left out, because
            depth could no longer be computed from it.
    """
    if layout not in PACKED:
        return None
    packing, right_first = PACKED[layout]
    if camera is None:
        return VideoMarks(packing=packing, right_first=right_first)
    baseline_m = strength * camera.baseline_m
    return VideoMarks(
        packing=packing,
        right_first=right_first,
        field_of_view_deg=degrees(2 * atan(width_px / (2 * camera.focal_px))),
        baseline_m=baseline_m if baseline_m > 0 and convergence_px == 0 else None,
    )
