"""Live view of cameras on a local web page: the left image, and its disparity in colour beside it.

The headless build of OpenCV has no windows, and a rig often has no screen. Browsers show a stream of JPEG
images (multipart/x-mixed-replace) without a script, on another machine through a tunnel.
"""

import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, cast
from urllib.parse import urlsplit

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from stereoweave.cameras.rectify import rectify
from stereoweave.cameras.rig import Rig
from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.colormap import colour_disparity, find_colour_range_px
from stereoweave.matching.estimate import match
from stereoweave.matching.matcher import Matcher
from stereoweave.pictures.pair_layouts import PAIR_LAYOUTS, detect_layout
from stereoweave.stereo import StereoCamera, StereoPair

Picture = UInt8[np.ndarray, "h w 3"]
Frame = UInt8[np.ndarray, "rows columns 3"]

_ADDRESS = "127.0.0.1"
# Other names are refused: another site could point its own name at this address (DNS rebinding).
_HOST_NAMES = (_ADDRESS, "localhost")
# Not "picture": FFmpeg, a possible client, mistakes its first letters for the start of a QuickTime file.
_BOUNDARY = "frame"
_PAGE = b"""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>Stereoweave live</title>
<style>
  body { margin: 0; background: #111 }
  img { display: block; width: 100vw; height: 100vh; object-fit: contain }
</style>
<img src="/stream" alt="The left picture, and its disparity in colours beside it">
</html>
"""
_DEFAULT_RATE = 25.0
# A network stream may be slow; a camera without a frame for this long is disconnected.
_TIMEOUT_S = 10.0
# The share by which the colour range follows that of a new frame; at 1 the colours would flicker.
_RANGE_SHARE = 0.1
_RANGE_STEP_PX = 4
_RATE_FRAMES = 30
_STRIP_PX, _FONT, _FONT_SCALE = 32, cv2.FONT_HERSHEY_SIMPLEX, 0.6
_JPEG_QUALITY = 85


class Moment(NamedTuple):
    """Simultaneous RGB images of all sources, their number from 0, and their time (time.monotonic)."""

    number: int
    pictures: tuple[Picture, ...]
    taken_s: float


class Capture:
    """One or two sources, read in step by a thread that keeps only the newest moment.

    A video is read at its own frame rate, like a camera.

    Args:
        sources: A source with both views, or two, the left one first. Each is a camera's number, a video
            file, a stream's address, or a series of pictures such as frame%03d.png.

    Raises:
        FormatError: If a source cannot be opened.
        StereoweaveError: If there are more than two.
    """

    def __init__(self, sources: Sequence[str]) -> None:
        if len(sources) > 2:
            raise StereoweaveError(
                f"expected one SOURCE with both views, or LEFT RIGHT, found {len(sources)}: "
                f"{' '.join(sources)}"
            )
        self.name, self.count = " and ".join(sources), len(sources)
        self._captures = [_open_source(source) for source in sources]
        first = self._captures[0]
        # A picture or a recorded stream has no frame count.
        self._is_recording = first.get(cv2.CAP_PROP_FRAME_COUNT) > 0 or Path(sources[0]).is_file()
        rate = first.get(cv2.CAP_PROP_FPS)
        self._step_s = 1 / (rate if rate > 0 else _DEFAULT_RATE)
        self._newest: Moment | None = None
        self._ended = False
        self._changed, self._stopped = threading.Condition(), threading.Event()
        self._thread = threading.Thread(target=self._keep_reading, daemon=True)

    def __enter__(self) -> "Capture":
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stopped.set()
        self._thread.join(timeout=1)  # a camera that hangs ends with the process

    def newest(self, after: int) -> Moment | None:
        """Wait for the newest moment with a number above `after`; None at the end of a video.

        Raises:
            StereoweaveError: If a camera or stream stops, or a video has no frame.
        """
        with self._changed:
            came = self._changed.wait_for(lambda: self._ended or self._has_newer(after), _TIMEOUT_S)
            if self._has_newer(after):
                return self._newest
        if came and self._is_recording and after >= 0:
            return None
        found = "the end of what it gives" if came else f"nothing for {_TIMEOUT_S:g} s"
        raise StereoweaveError(
            f"{self.name}: expected frames, found {found} after {after + 1}; is it still connected?"
        )

    def _has_newer(self, after: int) -> bool:
        return self._newest is not None and self._newest.number > after

    def _keep_reading(self) -> None:
        begin_s = time.monotonic()
        try:
            for number in count():
                pictures = self._read()
                early_s = begin_s + number * self._step_s - time.monotonic() if self._is_recording else 0
                if pictures is None or self._stopped.wait(max(early_s, 0)):
                    return
                with self._changed:
                    self._newest = Moment(number, pictures, time.monotonic())
                    self._changed.notify_all()
        finally:
            for capture in self._captures:
                capture.release()
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _read(self) -> tuple[Picture, ...] | None:
        # Grab all before decoding any, so that two cameras are as close in time as possible.
        if not all([capture.grab() for capture in self._captures]):
            return None
        frames = [capture.retrieve() for capture in self._captures]
        if not all(well for well, _ in frames):
            return None
        return tuple(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB) for _, frame in frames)


class Screen(ThreadingHTTPServer):
    """A web page on loopback that shows the newest image to every visitor.

    Args:
        port: The port; 0 for any free one.

    Raises:
        StereoweaveError: If the port is in use.
    """

    def __init__(self, port: int) -> None:
        try:
            super().__init__((_ADDRESS, port), _Handler)
        except OSError as error:
            raise StereoweaveError(
                f"expected a free port, found {port} ({error.strerror}); use 0 for any free port",
                setting="port",
            ) from error
        self.url = f"http://{_ADDRESS}:{self.server_port}/"
        self._jpeg, self._number, self._closed = b"", 0, False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self.serve_forever, daemon=True)

    def __enter__(self) -> "Screen":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
        self.shutdown()
        self.server_close()

    def close(self) -> None:
        """End the streams after the newest image."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def show(self, picture: Picture) -> None:
        """Show an RGB image from now on."""
        _, jpeg = cv2.imencode(
            ".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        )
        with self._changed:
            self._jpeg, self._number = jpeg.tobytes(), self._number + 1
            self._changed.notify_all()

    def pictures(self) -> Iterator[bytes]:
        """Yield the images as JPEG, from the current one on; images that come too fast are skipped."""
        shown = 0
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._number > shown)  # noqa: B023 - called at once
                if self._number == shown:
                    return
                jpeg, shown = self._jpeg, self._number
            yield jpeg


class _Handler(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        if urlsplit(f"//{self.headers.get('Host', '')}").hostname not in _HOST_NAMES:
            self.send_error(403, "only for this machine")
        elif self.path == "/":
            self._send_headers("text/html; charset=utf-8")
            self.wfile.write(_PAGE)
        elif self.path == "/stream":
            with suppress(ConnectionError):  # the visitor has left
                self._stream()
        else:
            self.send_error(404)

    def log_message(self, format: str, *values: object) -> None:
        """Log nothing: each request would print a line on the terminal."""

    def _send_headers(self, kind: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.end_headers()

    def _stream(self) -> None:
        boundary = f"\r\n--{_BOUNDARY}\r\n".encode()
        self._send_headers(f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
        self.wfile.write(boundary)
        for jpeg in cast(Screen, self.server).pictures():
            header = f"Content-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n".encode()
            # Send the boundary at once: a browser shows an image when it reaches its end.
            self.wfile.write(header + jpeg + boundary)


@dataclass
class LiveTally:
    """Statistics of the frames shown so far."""

    shown: int = 0
    last: int = -1
    waited_s: float = 0.0
    first_s: float = 0.0
    last_s: deque[float] = field(default_factory=lambda: deque(maxlen=_RATE_FRAMES))

    def add(self, moment: Moment, now_s: float) -> None:
        """Count a moment that is shown now."""
        self.first_s = self.first_s if self.shown else now_s
        self.shown, self.last = self.shown + 1, moment.number
        self.waited_s += now_s - moment.taken_s
        self.last_s.append(now_s)

    @property
    def rate(self) -> float:
        """Frames per second over the last frames; 0 for a single one."""
        return _measure_rate(len(self.last_s), self.last_s[-1] - self.last_s[0])

    def describe(self) -> str:
        """Describe the statistics in one line."""
        if not self.shown:
            return "nothing was shown"
        rate = _measure_rate(self.shown, self.last_s[-1] - self.first_s)
        return (
            f"{self.shown} frames shown of {self.last + 1}, {rate:.1f} a second, "
            f"{1000 * self.waited_s / self.shown:.0f} ms after they came"
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
        capture: The sources.
        screen: The page to show them on.
        matcher: The matcher for the disparity.
        tally: Updated with each frame, so that it is valid even after an error.
        format: The frame packing of a single source, a name in `PAIR_LAYOUTS`. Default: detected.
        rig: The calibration to rectify the images with. Default: they are rectified already.
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
    """Return the colour range after a frame: a step from the previous one towards the frame's own range."""
    wanted_px = find_colour_range_px(disparity_px[::_RANGE_STEP_PX, ::_RANGE_STEP_PX])
    if range_px is None:
        return wanted_px
    low_px, high_px = (old + _RANGE_SHARE * (new - old) for old, new in zip(range_px, wanted_px, strict=True))
    return low_px, high_px


def compose(
    pair: StereoPair, disparity_px: Float[np.ndarray, "h w"], range_px: tuple[float, float], status: str
) -> Frame:
    """Draw the left image, its disparity beside it, and a line of text above both."""
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
    """Describe the first and the last colour, in metres if the camera is known, else in pixels."""
    if camera is None:
        return "disparity {:.1f} px (blue) to {:.1f} px (red)".format(*range_px)
    far_m, near_m = camera.depth_m(np.array([range_px]))[0]
    return f"depth {far_m:.2f} m (blue) to {near_m:.2f} m (red)"


def _split_pair(pictures: Sequence[Picture], format: str | None) -> StereoPair:
    if format is None:
        left, right = pictures
    else:
        [both] = pictures
        PAIR_LAYOUTS[format].eye_size_px(both.shape[1], both.shape[0])  # raises if it cannot be halved
        left, right = PAIR_LAYOUTS[format].eyes(both)
    return StereoPair(left=left, right=right)


def _open_source(source: str) -> cv2.VideoCapture:
    level = cv2.utils.logging.getLogLevel()
    # The error below reports a failure; OpenCV would print it too.
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    capture = cv2.VideoCapture(int(source) if source.isdigit() else source)
    cv2.utils.logging.setLogLevel(level)
    if capture.isOpened():
        return capture
    if source.isdigit():
        found = "no camera of that number that is free"
    elif "://" in source:
        found = "no stream at that address"
    else:
        found = "something else" if Path(source).exists() else "no such file"
    raise FormatError(
        f"{source}: expected a camera's number, a video file, the address of a stream, or pictures as "
        f"frame%03d.png, found {found}"
    )


def _measure_rate(frames: int, seconds: float) -> float:
    return (frames - 1) / seconds if seconds > 0 else 0.0
