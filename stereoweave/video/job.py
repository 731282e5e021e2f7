"""Settings of a video conversion."""

from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite

from stereoweave.arguments import check_choice
from stereoweave.errors import NameOf, Remedy, StereoweaveError, keyword
from stereoweave.matching.backend import Backend
from stereoweave.rendering.comfort import ScreenChoice
from stereoweave.rendering.layouts import LAYOUTS, Eye, check_positions, check_shows_depth
from stereoweave.video.converted_frames import ConvertedFrame
from stereoweave.video.sphere_output import WholeOutput

_BITS = 8, 10
_TWO_LAYERS = "mvhevc"

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
        screen: Screen that decides strength and convergence frame by frame, in their place; for layouts of
            several views.
        whole: Output for the whole field of view of a VR180 or 360-degree video; None for a window.
        backend: Backend that matches the frames.
        name_of: Function that returns the front end's name for a setting, used in notes.
        on_converted: Function that is called with each converted frame, in a thread of the conversion, which
            waits for it. An error that it raises ends the conversion.
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
    screen: ScreenChoice | None = None
    whole: WholeOutput | None = None
    backend: Backend = Backend()
    name_of: NameOf = keyword
    on_converted: Callable[[ConvertedFrame], None] | None = None

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
        if self.layout is not None:
            check_choice("layout", self.layout, LAYOUTS)
        if self.screen is not None:
            check_shows_depth(self.layout or given[0])
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
    def join(self) -> Callable[[Eye, Eye], Eye] | None:
        """Function that makes the output from the pictures of both cameras; None if it shows their depth."""
        if self.strength != 1 or self.convergence_px or self.screen:
            return None
        join = self.arrangement
        if self.position in (0, 1):
            join = _take_right if self.position else _take_left
        if join is None or self.whole is None:
            return join
        spread, arrange = self.whole.spread, join
        return lambda left, right: spread(arrange(left, right))

    @property
    def is_fine(self) -> bool:
        """Whether output images are rendered from all bits of the frames, in the video's own colours."""
        return self.bits > _BITS[0] and (self.position is not None or self.arrangement is not None)

    @property
    def arrangement(self) -> Callable[[Eye, Eye], Eye] | None:
        """Function that arranges both eyes' views in the layout; None if it shows others, or mixes them."""
        return LAYOUTS[self.layout].join if self.layout else None

    def name_of_saved(self, key: str) -> str:
        """Return the front end's name for a key in the saved settings."""
        if key in _SAVED_FACTS:
            return _SAVED_FACTS[key]
        setting = "format" if key == "arrangement" else key
        return self.name_of(setting) or setting


def _take_left(left: Eye, right: Eye) -> Eye:
    return left


def _take_right(left: Eye, right: Eye) -> Eye:
    return right
