"""Live view of cameras on a local web page: the left image next to its disparity in colour."""

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Float

from stereoweave.app.capture import Capture, Moment
from stereoweave.app.screen import Screen
from stereoweave.cameras.rectify import Rectification, Rectified, plan_rectification
from stereoweave.cameras.rig import Rig, pair_size_px
from stereoweave.cameras.unit_check import note_units
from stereoweave.errors import Note
from stereoweave.io.colormap import colour_disparity, find_colour_range_px
from stereoweave.matching.estimate import match
from stereoweave.matching.matcher import Matcher
from stereoweave.outputs.metres import format_metres
from stereoweave.pictures.pair_layouts import PAIR_LAYOUTS, Frame, Picture, detect_layout
from stereoweave.stereo import StereoCamera, StereoPair
from stereoweave.video.reader import check_unpacked

# Fraction by which the colour range moves towards a new frame's range; at 1, colours would flicker.
_RANGE_SHARE = 0.1
_RANGE_STEP_PX = 4
_RATE_FRAMES = 30
_STRIP_PX, _FONT, _FONT_SCALE = 32, cv2.FONT_HERSHEY_SIMPLEX, 0.6
_LEGEND_PX, _RAMP_END_PX, _LABELS = 40, 18, 4
# The depth of the middle is the median of a square that reaches this far to each side.
_MIDDLE_PX = 4


@dataclass
class LiveTally:
    """Statistics of the frames shown so far."""

    shown: int = 0
    last: int = -1
    waited_s: float = 0.0
    first_s: float = 0.0
    last_s: deque[float] = field(default_factory=lambda: deque(maxlen=_RATE_FRAMES))

    def add(self, moment: Moment, now_s: float) -> None:
        """Count a moment as shown at the time `now_s`."""
        self.first_s = self.first_s if self.shown else now_s
        self.shown, self.last = self.shown + 1, moment.number
        self.waited_s += now_s - moment.taken_s
        self.last_s.append(now_s)

    @property
    def rate(self) -> float:
        """Frames per second, averaged over the most recent frames; 0 for a single frame."""
        return _measure_rate(len(self.last_s), self.last_s[-1] - self.last_s[0])

    def describe(self) -> str:
        """Return the statistics as one line of text."""
        if not self.shown:
            return "no frame was shown"
        rate = _measure_rate(self.shown, self.last_s[-1] - self.first_s)
        return (
            f"{self.shown} of {self.last + 1} frames shown, {rate:.1f} per second, "
            f"{1000 * self.waited_s / self.shown:.0f} ms after capture"
        )


def show(  # noqa: PLR0913 - source, output and settings
    capture: Capture,
    screen: Screen,
    matcher: Matcher,
    tally: LiveTally,
    *,
    format: str | None = None,
    rig: Rig | None = None,
    tell: Callable[[Note], None] = lambda note: None,
) -> None:
    """Show captured images and their disparity until the sources end; the last ones say so.

    Args:
        capture: Source of the images.
        screen: Web page that shows the images.
        matcher: Matcher that estimates the disparity.
        tally: Statistics, updated with each frame so that they are valid even after an error.
        format: Frame packing of a single source, a name in `FRAME_PACKINGS`. Default: as the
            file declares, else detected.
        rig: Calibration with which to rectify the images. Default: the images are already rectified, by the
            camera that a spatial video declares.
        tell: Function that is called with each note on the sources and the calibration, at the first frame.

    Raises:
        StereoweaveError: A frame packing is given for a spatial video.
    """
    if capture.is_spatial:
        check_unpacked(capture.name, format)
    if capture.count == 2:
        format = None
    range_px: tuple[float, float] | None = None
    plan: Rectification | None = None
    while moment := capture.newest(tally.last):
        if capture.count == 1 and format is None:
            format = detect_layout(capture.name, moment.pictures, capture.declared_packing)
        split = _split_pair(moment.pictures, format)
        if rig and (plan is None or plan.size_px != pair_size_px(split)):
            plan = plan_rectification(rig, pair_size_px(split))
        ready = plan.apply(split) if plan else Rectified(pair=replace(split, camera=capture.camera))
        pair = ready.pair
        if not tally.shown:
            for note in [*capture.notes, *_note_odd_size(moment, format), *ready.notes, *_note_units(pair)]:
                tell(note)
        disparity_px = match(matcher, pair).disparity_px
        range_px = follow_range(range_px, disparity_px)
        tally.add(moment, time.monotonic())
        status = f"{tally.rate:.1f} frames/s, {1000 * (tally.last_s[-1] - moment.taken_s):.0f} ms behind"
        screen.show(compose(pair, disparity_px, range_px, status))
    if range_px:
        screen.show(compose(pair, disparity_px, range_px, "the end"))


def _note_odd_size(moment: Moment, format: str | None) -> list[Note]:
    height_px, width_px = moment.pictures[0].shape[:2]
    return PAIR_LAYOUTS[format].note_odd_size(width_px, height_px) if format else []


def _note_units(pair: StereoPair) -> list[Note]:
    return note_units(pair.camera, pair.left.shape[1]) if pair.camera else []


def follow_range(
    range_px: tuple[float, float] | None, disparity_px: Float[np.ndarray, "h w"]
) -> tuple[float, float]:
    """Return the colour range for a new frame: the previous range, moved towards the frame's own range."""
    wanted_px = find_colour_range_px(disparity_px[::_RANGE_STEP_PX, ::_RANGE_STEP_PX])
    if range_px is None:
        return wanted_px
    low_px, high_px = (old + _RANGE_SHARE * (new - old) for old, new in zip(range_px, wanted_px, strict=True))
    return low_px, high_px


def compose(
    pair: StereoPair, disparity_px: Float[np.ndarray, "h w"], range_px: tuple[float, float], status: str
) -> Frame:
    """Draw the left image and its disparity side by side, a line of text above, and a legend below.

    A cross marks the middle of both, whose depth or disparity is part of the text.
    """
    colours = colour_disparity(disparity_px, range_px)
    if pair.left_seen is not None:
        colours[~pair.left_seen] = 0
    both = np.hstack([_mark_middle(pair.left), _mark_middle(colours)])
    picture = cv2.copyMakeBorder(both, _STRIP_PX, 0, 0, 0, cv2.BORDER_CONSTANT)
    _write(picture, f"{status}; {describe_middle(pair, disparity_px)}", (8, 22), picture.shape[1] - 16)
    return np.vstack([picture, _draw_legend(pair.camera, range_px, both.shape[1])])


def describe_middle(pair: StereoPair, disparity_px: Float[np.ndarray, "h w"]) -> str:
    """Describe the depth at the cross in the left image, or the disparity if the camera is unknown."""
    height, width = disparity_px.shape
    rows, columns = (
        slice(max(0, side // 2 - _MIDDLE_PX), side // 2 + _MIDDLE_PX + 1) for side in (height, width)
    )
    [text] = label_values(pair.camera, [float(np.median(disparity_px[rows, columns]))])
    return f"{'disparity' if pair.camera is None else 'depth'} at the cross: {text}"


def label_values(camera: StereoCamera | None, disparities_px: Sequence[float]) -> list[str]:
    """Return each disparity as a depth in metres, or in pixels if the camera is unknown."""
    if camera is None:
        return [f"{disparity_px:.1f} px" for disparity_px in disparities_px]
    return [format_metres(float(depth_m)) for depth_m in camera.depth_m(np.array([disparities_px]))[0]]


def _draw_legend(camera: StereoCamera | None, range_px: tuple[float, float], width_px: int) -> Frame:
    """Draw the colours from the farthest to the nearest, with values in metres or pixels below them."""
    ramp = colour_disparity(np.linspace(*range_px, width_px, dtype=np.float32)[None], range_px)
    legend = np.zeros((_LEGEND_PX, width_px, 3), np.uint8)
    legend[4:_RAMP_END_PX] = ramp
    labels = label_values(camera, np.linspace(*range_px, _LABELS).tolist())
    labels[0], labels[-1] = f"far {labels[0]}", f"near {labels[-1]}"
    room_px = width_px // _LABELS - 8
    for index, label in enumerate(labels):
        share = index / (_LABELS - 1)
        text_px = min(room_px, _measure_text_px(label))
        left_px = round(4 + share * (width_px - 8 - text_px))
        _write(legend, label, (left_px, _LEGEND_PX - 6), room_px)
    return legend


def _mark_middle(image: Frame) -> Frame:
    """Return the image with a white cross in its middle, which has a black border."""
    marked, middle = image.copy(), (image.shape[1] // 2, image.shape[0] // 2)
    for colour, thickness_px in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.drawMarker(marked, middle, colour, cv2.MARKER_CROSS, 2 * _MIDDLE_PX + 5, thickness_px)
    return marked


def _write(picture: Frame, text: str, place: tuple[int, int], room_px: int) -> None:
    """Write white text into a picture, small enough to take at most `room_px`."""
    scale = _FONT_SCALE * min(1.0, room_px / _measure_text_px(text))
    cv2.putText(picture, text, place, _FONT, scale, (255, 255, 255), 1, cv2.LINE_AA)


def _measure_text_px(text: str) -> int:
    (width_px, _), _ = cv2.getTextSize(text, _FONT, _FONT_SCALE, 1)
    return width_px


def _split_pair(pictures: Sequence[Picture], format: str | None) -> StereoPair:
    if format is None:
        left, right = pictures
    else:
        [both] = pictures
        PAIR_LAYOUTS[format].eye_size_px(both.shape[1], both.shape[0])  # raises FormatError
        left, right = PAIR_LAYOUTS[format].eyes(both)
    return StereoPair(left=left, right=right)


def _measure_rate(frames: int, seconds: float) -> float:
    return (frames - 1) / seconds if seconds > 0 else 0.0
