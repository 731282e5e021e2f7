"""Output frames for the whole field of view of a VR180 or 360-degree video, and their marks."""

from dataclasses import replace

import numpy as np

from stereoweave.cameras.sphere_windows import BLIND_DEG
from stereoweave.pictures.panoramas import SphereView, check_whole_layout, spread_views
from stereoweave.stereo import Estimate
from stereoweave.video.layout_marks import PACKED
from stereoweave.video.mp4_marks import VideoMarks
from stereoweave.video.writer import Picture


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

    def describe_nearness(self, range_px: tuple[float, float]) -> str:
        """Return what the colours of `measure_nearness` mean, for their range."""
        low_px, high_px = range_px
        return (
            f"nearness in the left view: {low_px:.2f} px is blue, {high_px:.2f} px is red; distance = "
            f"{self._window.focal_px:.6g} / px baselines; 0 px where the baseline vanishes"
        )

    def spread(self, picture: Picture) -> Picture:
        """Return an equirectangular output frame."""
        return spread_views(self._spreader, picture, self._layout)

    def marks(self, baseline_m: float | None) -> VideoMarks:
        """Return what the output file says about its views; `baseline_m` is as in `mark_layout`."""
        packed = PACKED.get(self._layout or "")
        return VideoMarks(
            packing=packed and packed.packing,
            right_first=packed is not None and packed.right_first,
            projection=self._name,
            baseline_m=baseline_m if packed else None,
        )
