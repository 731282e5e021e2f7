"""Conversion to layouts of half width or height from frames that are halved first.

Frames are then matched and rendered at the size at which the output shows them, in about half the time.
"""

from dataclasses import replace
from typing import NamedTuple

from stereoweave.io.images import SMALLEST_SIDE_PX
from stereoweave.rendering.layouts import LAYOUTS, squeeze
from stereoweave.stereo import StereoPair
from stereoweave.video.frame_groups import FrameGroup
from stereoweave.video.job import VideoJob
from stereoweave.video.reader import FinePair
from stereoweave.video.survey import Survey


class SqueezedJob(NamedTuple):
    """A job on frames that are halved.

    Attributes:
        job: The job on the halved frames.
        axis: Axis of the halving, 0 for half height and 1 for half width; None if frames keep their size.
    """

    job: VideoJob
    axis: int | None

    @property
    def scale(self) -> float:
        """Disparities of the halved frames divided by those of the frames."""
        return 0.5 if self.axis == 1 else 1.0

    def squeeze(self, group: FrameGroup) -> FrameGroup:
        """Return the group with its pairs halved."""
        if self.axis is None:
            return group
        pairs = [
            StereoPair(left=squeeze(pair.left, self.axis), right=squeeze(pair.right, self.axis))
            for pair in group.pairs
        ]
        frames = [frame.change_fine(self._squeeze_fine) for frame in group.frames]
        return FrameGroup(frames, pairs)

    def _squeeze_fine(self, pair: FinePair) -> FinePair:
        assert self.axis is not None
        return squeeze(pair[0], self.axis), squeeze(pair[1], self.axis)

    def squeeze_survey(self, survey: Survey) -> Survey:
        """Return the disparities of the halved frames."""
        low_px, high_px = survey.range_px
        match_range_px = survey.match_range_px
        return survey._replace(
            range_px=(self.scale * low_px, self.scale * high_px),
            middle_px=self.scale * survey.middle_px,
            match_range_px=match_range_px
            and (self.scale * match_range_px[0], self.scale * match_range_px[1]),
        )


def squeeze_job(job: VideoJob, size_px: tuple[int, int]) -> SqueezedJob:
    """Return the job for frames of this width and height; very small ones are not halved."""
    layout = LAYOUTS.get(job.layout or "")
    if layout is None or layout.squeezed is None or min(size_px) < 2 * SMALLEST_SIDE_PX:
        return SqueezedJob(job, None)
    full, axis = layout.squeezed
    squeezed = SqueezedJob(replace(job, layout=full), axis)
    if job.convergence_px is None:
        return squeezed
    moved_px = squeezed.scale * job.convergence_px
    return squeezed._replace(job=replace(squeezed.job, convergence_px=moved_px))
