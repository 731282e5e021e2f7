"""Live view of cameras on a local web page: the left image next to its disparity in colour."""

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float

from stereoweave.app.capture import Capture, Moment
from stereoweave.app.screen import Screen
from stereoweave.cameras.rectify import rectify
from stereoweave.cameras.rig import Rig
from stereoweave.io.colormap import colour_disparity, find_colour_range_px
from stereoweave.matching.estimate import match
from stereoweave.matching.matcher import Matcher
from stereoweave.pictures.pair_layouts import PAIR_LAYOUTS, Frame, Picture, detect_layout
from stereoweave.stereo import StereoCamera, StereoPair

# Fraction by which the colour range moves towards a new frame's range; at 1, colours would flicker.
_RANGE_SHARE = 0.1
_RANGE_STEP_PX = 4
_RATE_FRAMES = 30
_STRIP_PX, _FONT, _FONT_SCALE = 32, cv2.FONT_HERSHEY_SIMPLEX, 0.6


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
) -> None:
    """Show captured images and their disparity until the sources end.

    Args:
        capture: Source of the images.
        screen: Web page that shows the images.
        matcher: Matcher that estimates the disparity.
        tally: Statistics, updated with each frame so that they are valid even after an error.
        format: Frame packing of a single source, a name in `PAIR_LAYOUTS`. Default: detected.
        rig: Calibration with which to rectify the images. Default: the images are already rectified.
    """
    range_px: tuple[float, float] | None = None
    while moment := capture.newest(tally.last):
        if capture.count == 1 and format is None:
            format = detect_layout(capture.name, moment.pictures)
        pair = _split_pair(moment.pictures, format)
        pair = rectify(pair, rig).pair if rig else pair
        disparity_px = match(matcher, pair).disparity_px
        range_px = follow_range(range_px, disparity_px)
        tally.add(moment, time.monotonic())
        status = f"{tally.rate:.1f} frames/s, {1000 * (tally.last_s[-1] - moment.taken_s):.0f} ms"
        screen.show(compose(pair, disparity_px, range_px, status))


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
    """Draw the left image and its disparity side by side, with a line of text above."""
    colours = colour_disparity(disparity_px, range_px)
    if pair.left_seen is not None:
        colours[~pair.left_seen] = 0
    both = np.hstack([pair.left, colours])
    text = f"{status}; {describe_range(pair.camera, range_px)}"
    (width_px, _), _ = cv2.getTextSize(text, _FONT, _FONT_SCALE, 1)
    scale = _FONT_SCALE * min(1.0, both.shape[1] / (width_px + _STRIP_PX))
    picture = cv2.copyMakeBorder(both, _STRIP_PX, 0, 0, 0, cv2.BORDER_CONSTANT)
    return cv2.putText(picture, text, (8, 22), _FONT, scale, (255, 255, 255), 1, cv2.LINE_AA)


def describe_range(camera: StereoCamera | None, range_px: tuple[float, float]) -> str:
    """Return a legend for the first and last colours, in metres if the camera is known, else in pixels."""
    if camera is None:
        return "disparity {:.1f} px (blue) to {:.1f} px (red)".format(*range_px)
    far_m, near_m = camera.depth_m(np.array([range_px]))[0]
    return f"depth {far_m:.2f} m (blue) to {near_m:.2f} m (red)"


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
