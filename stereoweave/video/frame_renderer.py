"""Rendering of a video's output frames."""

from stereoweave.io.colormap import colour_disparity
from stereoweave.rendering.fine_layouts import compose_fine, to_8_bits, to_16_bits
from stereoweave.rendering.layouts import LAYOUTS, LayoutOptions, has_two_views
from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import Estimate, StereoPair
from stereoweave.video.comfort_path import FrameComfort
from stereoweave.video.depth_codes import encode_grey10, encode_grey16
from stereoweave.video.job import VideoJob
from stereoweave.video.reader import FinePair
from stereoweave.video.survey import Survey
from stereoweave.video.writer import Picture


class FrameRenderer:
    """Renderer of a job's output frames.

    Args:
        job: Settings of the conversion.
        survey: Disparities of the whole video.
    """

    def __init__(self, job: VideoJob, survey: Survey) -> None:
        self._job, self._survey = job, survey
        self._fixed = FrameComfort(
            strength=job.strength, convergence_px=_find_plane_px(job, survey), windows_px=(0.0, 0.0)
        )

    def __call__(
        self,
        pair: StereoPair,
        estimate: Estimate,
        fine: FinePair | None = None,
        comfort: FrameComfort | None = None,
    ) -> Picture:
        """Return the output image of one frame.

        Args:
            pair: The frame's aligned pair.
            estimate: The pair's estimate.
            fine: The pair's images in more than 8 bits; the output then has 16.
            comfort: Values that take the place of the job's strength and convergence.
        """
        whole = self._job.whole
        if whole is None:
            return self._render(pair, estimate, fine, comfort)
        seen = whole.measure_nearness(estimate) if self._job.depth else estimate
        return whole.spread(self._render(pair, seen, fine, comfort))

    def _render(
        self, pair: StereoPair, estimate: Estimate, fine: FinePair | None, comfort: FrameComfort | None
    ) -> Picture:
        job, range_px = self._job, self._survey.range_px
        if job.depth:
            return colour_disparity(estimate.disparity_px, range_px)
        if job.depth10:
            return encode_grey10(estimate.disparity_px, range_px)
        if job.depth16:
            return encode_grey16(estimate.disparity_px)
        comfort = comfort or self._fixed
        renderer = Renderer(
            StereoPair(left=to_8_bits(fine[0]), right=to_8_bits(fine[1])) if fine else pair,
            estimate,
            strength=comfort.strength,
            convergence_px=comfort.convergence_px,
            threads=job.backend.threads,
            fine=fine,
        )
        if job.position is not None:
            if fine:
                return to_16_bits(renderer.fine_view(job.position))
            return renderer.view(job.position).image
        windows_px = comfort.windows_px if has_two_views(job.layout) else (0.0, 0.0)
        if fine and job.arrangement:
            return compose_fine(renderer, job.arrangement, windows_px)
        options = LayoutOptions(range_px=range_px, windows_px=windows_px)
        return LAYOUTS[str(job.layout)].compose(renderer, options)


def _find_plane_px(job: VideoJob, survey: Survey) -> float:
    """Return the disparity of the points that stay in the same column in all views."""
    if job.convergence_px is not None:
        return job.convergence_px
    return survey.middle_px if job.layout and LAYOUTS[job.layout].converged else 0.0
