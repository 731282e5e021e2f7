"""Settings of a video conversion, and the rendering of its output frames."""

from dataclasses import dataclass
from math import isfinite

import numpy as np
from jaxtyping import Float, UInt16

from stereoweave.errors import NameOf, Note, Remedy, StereoweaveError, keyword
from stereoweave.io.colormap import colour_disparity
from stereoweave.matching.backend import Backend
from stereoweave.rendering.fine_layouts import FINE_LAYOUTS, compose_fine, to_8_bits, to_16_bits
from stereoweave.rendering.layouts import LAYOUTS, LayoutOptions, check_positions
from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import Estimate, StereoCamera, StereoPair
from stereoweave.video.reader import FinePair
from stereoweave.video.sphere_output import WholeOutput
from stereoweave.video.survey import Survey
from stereoweave.video.writer import Picture

_STEPS_PER_PX, _MOST_GREY16_PX = 256, 255.99
# Black and white of a video in 10 bits.
_BLACK_10, _WHITE_10 = 64, 940
_BITS = 8, 10
_TWO_LAYERS = "mvhevc"
_NO_METRES = "no depth in metres, because frames were rectified"

# Keys of the saved settings that identify the input and the version, and their names in error messages.
_SAVED_FACTS = {"film": "video", "stereoweave": "stereoweave"}


@dataclass(frozen=True, kw_only=True)
class VideoJob:
    """Settings of a video conversion. Exactly one of the first five must be set.

    Attributes:
        depth: Output the left disparity in colour, with one range for the whole video.
        depth10: Output the left disparity as 10-bit grey, linear over the range of the whole video.
        depth16: Output the left disparity as 16-bit grey, px * 256 as in disparity.png. Values are clipped to
            the range from 1/256 to 255.99 px.
        position: Output the view from this position, where 0 is the left camera and 1 the right one.
        layout: Output the layout with this name in `LAYOUTS`.
        bits: Bits of each colour of a view or a layout: 8; or 10, which keeps HDR in views, and in layouts
            with one view for each eye.
        strength: Factor by which the baseline is multiplied.
        convergence_px: Disparity of the points that stay in the same column in all views. Default: the median
            disparity of the scene for layouts that overlay their views, 0 for all others.
        rectify: Whether to rectify the shots whose rows are apart, and to swap the sides if they are swapped.
        whole: Output for the whole field of view of a VR180 or 360-degree video; None for a window.
        backend: Backend that matches the frames.
        name_of: Function that returns the front end's name for a setting, used in notes.
    """

    depth: bool = False
    depth10: bool = False
    depth16: bool = False
    position: float | None = None
    layout: str | None = None
    bits: int = 8
    strength: float = 1.0
    convergence_px: float | None = None
    rectify: bool = True
    whole: WholeOutput | None = None
    backend: Backend = Backend()
    name_of: NameOf = keyword

    def __post_init__(self) -> None:
        kinds = {
            "depth": self.depth,
            "depth10": self.depth10,
            "depth16": self.depth16,
            "position": self.position is not None,
            "layout": self.layout is not None,
        }
        given = [kind for kind, is_given in kinds.items() if is_given]
        if len(given) != 1:
            raise StereoweaveError(
                f"expected one kind of output, found {' and '.join(given) or 'none'}",
                remedy=Remedy("choose one", tuple(kinds)),
            )
        if self.layout == _TWO_LAYERS:
            raise StereoweaveError(
                f"expected a layout in one layer, found {_TWO_LAYERS!r}, for which PyAV brings no encoder",
                remedy=Remedy("choose side_by_side, which is marked for headsets"),
                setting="layout",
            )
        if self.layout not in (None, *LAYOUTS):
            raise StereoweaveError(
                f"expected one of {', '.join(LAYOUTS)}, found {self.layout!r}", setting="layout"
            )
        self._check_numbers(given[0] if self.layout is None else f"layout {self.layout}")
        self._check_bits(given[0])
        check_positions(self._positions, self.strength)

    def _check_bits(self, kind: str) -> None:
        if self.bits not in _BITS:
            raise StereoweaveError(f"expected 8 or 10, found {self.bits!r}", setting="bits")
        if self.bits != _BITS[0] and kind not in ("position", "layout"):
            raise StereoweaveError(
                f"expected a view or a layout in {self.bits} bits, found {kind}",
                remedy=Remedy("choose depth in 10 or 16 bits", ("depth10", "depth16")),
                setting="bits",
            )

    def _check_numbers(self, kind: str) -> None:
        """Raise StereoweaveError if a number is not finite, or has no effect on this kind of output."""
        numbers = {"strength": (self.strength, 1.0), "convergence_px": (self.convergence_px, None)}
        for setting, (value, unset) in numbers.items():
            if value == unset or value is None:
                continue
            if not isfinite(value):
                raise StereoweaveError(f"expected a finite number, found {value}", setting=setting)
            if not self._positions:
                raise StereoweaveError(
                    f"expected a view or a layout of views as output, found {kind}", setting=setting
                )

    @property
    def _positions(self) -> tuple[float, ...]:
        if self.layout:
            return LAYOUTS[self.layout].positions
        return () if self.position is None else (self.position,)

    @property
    def is_fine(self) -> bool:
        """Whether output images are rendered from all bits of the frames, in the video's own colours."""
        return self.bits > _BITS[0] and (self.position is not None or self.layout in FINE_LAYOUTS)

    def render_fine_frame(self, fine: FinePair, estimate: Estimate, survey: Survey) -> Picture:
        """Render the output image of one frame, in 16 bits, from its fine pictures."""
        renderer = Renderer(
            StereoPair(left=to_8_bits(fine[0]), right=to_8_bits(fine[1])),
            estimate,
            strength=self.strength,
            convergence_px=self._find_plane_px(survey),
            threads=self.backend.threads,
            fine=fine,
        )
        if self.position is not None:
            return to_16_bits(renderer.fine_view(self.position))
        return compose_fine(renderer, str(self.layout))

    def render_frame(self, pair: StereoPair, estimate: Estimate, survey: Survey) -> Picture:
        """Render the output image of one frame."""
        if self.whole is None:
            return self._render_pair(pair, estimate, survey)
        seen = self.whole.measure_nearness(estimate) if self.depth else estimate
        return self.whole.spread(self._render_pair(pair, seen, survey))

    def _render_pair(self, pair: StereoPair, estimate: Estimate, survey: Survey) -> Picture:
        if self.depth:
            return colour_disparity(estimate.disparity_px, survey.range_px)
        if self.depth10:
            return _encode_grey10(estimate.disparity_px, survey.range_px)
        if self.depth16:
            return _encode_grey16(estimate.disparity_px)
        renderer = Renderer(
            pair,
            estimate,
            strength=self.strength,
            convergence_px=self._find_plane_px(survey),
            threads=self.backend.threads,
        )
        if self.position is not None:
            return renderer.view(self.position).image
        return LAYOUTS[str(self.layout)].compose(renderer, LayoutOptions(range_px=survey.range_px))

    def _find_plane_px(self, survey: Survey) -> float:
        """Return the disparity of the points that stay in the same column in all views."""
        if self.convergence_px is not None:
            return self.convergence_px
        return survey.middle_px if self.layout and LAYOUTS[self.layout].converged else 0.0

    def name_of_saved(self, key: str) -> str:
        """Return the front end's name for a key in the saved settings."""
        if key in _SAVED_FACTS:
            return _SAVED_FACTS[key]
        setting = "format" if key == "arrangement" else key
        return self.name_of(setting) or setting

    def find_losses(self, survey: Survey) -> list[Note]:
        """Return a list that contains a note if the output format cannot represent all disparities."""
        low_px, high_px = survey.range_px
        if not self.depth16 or (low_px >= 0 and high_px <= _MOST_GREY16_PX):
            return []
        text = (
            f"16-bit grey covers 0 to {_MOST_GREY16_PX} px; this video's disparities range from "
            f"{low_px:.1f} to {high_px:.1f} px, so some are clipped"
        )
        return [Note(text, Remedy("show all of them in colours", ("depth",)))]

    def describe_values(
        self, survey: Survey, camera: StereoCamera | None = None, *, rectified: bool = False
    ) -> dict[str, str]:
        """Return metadata for the output file that explains how pixel values encode disparity.

        With a camera, it also explains their depth in metres, or says that rectified frames have none: their
        rectification turns the cameras, which shifts the disparity of infinitely far points.
        """
        ending = f"; {_NO_METRES}" if camera and rectified else ""
        camera = None if rectified else camera
        low_px, high_px = survey.range_px
        if self.depth16:
            text = f"16-bit grey: disparity of the left view in pixels = value / {_STEPS_PER_PX}"
            if camera:
                constant = camera.focal_px * camera.baseline_m * _STEPS_PER_PX
                text += f"; depth in metres = {constant:.6g} / value"
            return {"comment": text + ending}
        if self.depth10:
            step_px = (high_px - low_px) / (_WHITE_10 - _BLACK_10)
            text = (
                f"10-bit grey: disparity of the left view in pixels = {low_px:.4f} + {step_px:.7f} * "
                f"(value - {_BLACK_10}), for values from {_BLACK_10} to {_WHITE_10}"
            )
            if camera:
                text += f"; depth in metres = {camera.focal_px * camera.baseline_m:.6g} / disparity"
            return {"comment": text + ending}
        if self.depth:
            low, high = (_describe_disparity(value_px, camera) for value_px in survey.range_px)
            return {"comment": f"disparity of the left view: {low} is blue, {high} is red{ending}"}
        if self.layout == "rgbd":
            return {"comment": f"disparity in grey: {low_px:.2f} px is black, {high_px:.2f} px is white"}
        return {}


def _describe_disparity(disparity_px: float, camera: StereoCamera | None) -> str:
    text = f"{disparity_px:.2f} px"
    if camera is None:
        return text
    depth_m = float(camera.depth_m(np.array([[disparity_px]]))[0, 0])
    return f"{text} ({depth_m:.3g} m)" if isfinite(depth_m) else f"{text} (infinity)"


def _encode_grey10(
    disparity_px: Float[np.ndarray, "h w"], range_px: tuple[float, float]
) -> UInt16[np.ndarray, "h w"]:
    low_px, high_px = range_px
    share = np.clip((disparity_px - low_px) / (high_px - low_px), 0, 1)
    return np.rint(_BLACK_10 + (_WHITE_10 - _BLACK_10) * share).astype(np.uint16)


def _encode_grey16(disparity_px: Float[np.ndarray, "h w"]) -> UInt16[np.ndarray, "h w"]:
    # The value 0 is reserved for unknown, as in disparity.png.
    return np.clip(np.rint(_STEPS_PER_PX * disparity_px), 1, 65535).astype(np.uint16)
