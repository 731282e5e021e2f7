"""Output frames for the whole field of view of a VR180 or 360-degree video, and their marks."""

from dataclasses import replace

import numpy as np

from stereoweave.cameras.sphere_windows import BLIND_DEG
from stereoweave.pictures.panoramas import SphereView, check_whole_layout, spread_views
from stereoweave.stereo import Estimate
from stereoweave.video.mp4_marks import VideoMarks
from stereoweave.video.writer import Picture

# The packing of each layout with one view for each eye, and whether the right view comes first.
_PACKED = {
    "side_by_side": ("side_by_side", False),
    "crossed": ("side_by_side", True),
    "top_bottom": ("top_bottom", False),
}


class WholeOutput:
    """Spreader of output frames over equirectangular ones, the same for a whole video.

    Raises:
        StereoweaveError: The layout cannot show the whole field of view.
    """

    def __init__(self, view: SphereView, layout: str | None) -> None:
        check_whole_layout(layout)
        self._window, self._layout = view.window, layout
        self._spreader, self._name = view.spreader(), view.whole_projection.name
        self._blind = view.window.blindness_deg(view.window.rays()) > BLIND_DEG

    def measure_nearness(self, estimate: Estimate) -> Estimate:
        """Return the estimate with disparities as a baseline across each ray would give them.

        They are 0 where the baseline vanishes.
        """
        nearness = self._window.nearness(estimate.disparity_px) * self._window.focal_px
        return replace(estimate, disparity_px=np.where(self._blind, 0, nearness).astype(np.float32))

    def spread(self, picture: Picture) -> Picture:
        """Return an equirectangular output frame."""
        return spread_views(self._spreader, picture, self._layout)

    def marks(self, baseline_m: float | None) -> VideoMarks:
        """Return what the output file says about its views; `baseline_m` is their distance, if known."""
        packing, right_first = _PACKED.get(self._layout or "", (None, False))
        return VideoMarks(
            packing=packing,
            right_first=right_first,
            projection=self._name,
            baseline_m=baseline_m if packing and baseline_m else None,
        )
