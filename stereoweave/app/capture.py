"""Capture of live video from cameras, files and streams by a background thread."""

import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import cv2

from stereoweave.app.apart_capture import ApartCapture
from stereoweave.errors import FormatError, Note, StereoweaveError
from stereoweave.pictures.pair_layouts import Picture
from stereoweave.stereo import StereoCamera
from stereoweave.video.streams import refuse_playlist
from stereoweave.video.tracks import read_declared_packing

_DEFAULT_RATE = 25.0
# A network stream may be slow; a camera that delivers no frame for this long is disconnected.
_TIMEOUT_S = 10.0


class Moment(NamedTuple):
    """RGB images captured from all sources at the same time.

    Attributes:
        number: Number of the moment, counted from 0.
        pictures: One image per source; of a video whose views are apart, the left and the right view.
        taken_s: Time of capture, as returned by `time.monotonic`.
    """

    number: int
    pictures: tuple[Picture, ...]
    taken_s: float


class Capture:
    """One or two sources, read simultaneously by a thread that keeps only the newest moment.

    A video file is read at its own frame rate, as if it were a camera.

    Args:
        sources: One source with both views, or a left and a right source. Each is a camera number, a video
            file, a stream address, or a series of pictures such as frame%03d.png.
        loop: Begin a video file or a series of pictures again at its end. Cameras and streams have no end.
        format: Frame packing of a single source, a name in `FRAME_PACKINGS`. Default: as the source says.

    Attributes:
        name: The sources, for messages.
        count: Number of images of each moment.
        is_spatial: Whether the source is a spatial video.
        camera: Camera of the views, if a spatial video declares it.
        declared_packing: Frame packing that a video file with both views in each frame declares, if any.
        notes: Notes on the source.

    Raises:
        FormatError: If a source cannot be opened, or one of two has both views.
        StereoweaveError: If there are more than two sources.
    """

    def __init__(self, sources: Sequence[str], *, loop: bool = False, format: str | None = None) -> None:
        if len(sources) > 2:
            raise StereoweaveError(
                f"expected one source with both views, or a left and a right source, found {len(sources)}: "
                f"{' '.join(sources)}"
            )
        self.name, self.count = " and ".join(sources), len(sources)
        self._sources, self._format = sources, format
        self._captures = [_open_source(source, format) for source in sources]
        first = self._captures[0]
        apart = [capture for capture in self._captures if isinstance(capture, ApartCapture)]
        self.is_spatial = any(capture.packing is None for capture in apart)
        self.camera: StereoCamera | None = None
        self.declared_packing: str | None = None
        self.notes: Sequence[Note] = ()
        if isinstance(first, ApartCapture) and len(sources) == 1:
            self.count, self.camera, self.notes = 2, first.camera, first.notes
        elif apart:
            kind = "spatial video (MV-HEVC)" if self.is_spatial else f"video ({apart[0].packing})"
            raise FormatError(
                f"{self.name}: expected a left and a right video with one view each, found a {kind} with "
                "both views; give it alone"
            )
        elif Path(sources[0]).is_file():
            self.declared_packing = read_declared_packing(Path(sources[0]))
        # A single picture or a recorded stream has no frame count.
        self._is_recording = _count_frames(first) > 0 or Path(sources[0]).is_file()
        self._loop = loop and self._is_recording
        rate = _measure_rate(first)
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
        self._thread.join(timeout=1)  # if a camera hangs, its thread ends with the process

    def newest(self, after: int) -> Moment | None:
        """Return the newest moment as soon as its number exceeds `after`; None at the end of a video.

        Raises:
            StereoweaveError: If a camera or stream stops, or if a video has no frames.
        """
        with self._changed:
            came = self._changed.wait_for(lambda: self._ended or self._has_newer(after), _TIMEOUT_S)
            if self._has_newer(after):
                return self._newest
        if came and self._is_recording and after >= 0:
            return None
        found = "the end of the source" if came else f"nothing for {_TIMEOUT_S:g} s"
        raise StereoweaveError(
            f"{self.name}: expected frames, found {found} after frame {after + 1}; check the connection"
        )

    def _has_newer(self, after: int) -> bool:
        return self._newest is not None and self._newest.number > after

    def _keep_reading(self) -> None:
        begin_s = time.monotonic()
        try:
            for number in count():
                pictures = self._read()
                if pictures is None and self._loop and number:
                    self._rewind()
                    pictures = self._read()
                early_s = begin_s + number * self._step_s - time.monotonic() if self._is_recording else 0
                if pictures is None or self._stopped.wait(max(early_s, 0)):
                    return
                with self._changed:
                    self._newest = Moment(number, pictures, time.monotonic())
                    self._changed.notify_all()
        finally:
            self._release()
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _rewind(self) -> None:
        """Begin again. The files are opened anew, because a series of pictures cannot be wound back."""
        self._release()
        with suppress(FormatError):  # a file that is gone ends the video
            self._captures = [_open_source(source, self._format) for source in self._sources]

    def _release(self) -> None:
        for capture in self._captures:
            capture.release()

    def _read(self) -> tuple[Picture, ...] | None:
        # Grab all images before decoding any, so that they are as close in time as possible.
        if not all([capture.grab() for capture in self._captures]):
            return None
        pictures = [_retrieve(capture) for capture in self._captures]
        return sum(pictures, ()) if all(pictures) else None


_Source = cv2.VideoCapture | ApartCapture


def _retrieve(capture: _Source) -> tuple[Picture, ...]:
    """Return the images that were grabbed; none if they cannot be decoded."""
    if isinstance(capture, ApartCapture):
        return capture.retrieve()
    well, frame = capture.retrieve()
    return (cv2.cvtColor(frame, cv2.COLOR_BGR2RGB),) if well else ()


def _count_frames(capture: _Source) -> float:
    return 1 if isinstance(capture, ApartCapture) else capture.get(cv2.CAP_PROP_FRAME_COUNT)


def _measure_rate(capture: _Source) -> float:
    return capture.rate if isinstance(capture, ApartCapture) else capture.get(cv2.CAP_PROP_FPS)


def _open_source(source: str, format: str | None) -> _Source:
    if Path(source).is_file():
        refuse_playlist(Path(source))
    if apart := ApartCapture.open(source, format):
        return apart
    level = cv2.utils.logging.getLogLevel()
    # A failure is reported by the error below; OpenCV would also print a line about it.
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    capture = cv2.VideoCapture(int(source) if source.isdigit() else source)
    cv2.utils.logging.setLogLevel(level)
    if capture.isOpened():
        return capture
    if source.isdigit():
        found = "no free camera with that number"
    elif "://" in source:
        found = "no stream at that address"
    else:
        exists = "a folder" if Path(source).is_dir() else "a file that OpenCV cannot open"
        found = exists if Path(source).exists() else "no such file"
    raise FormatError(
        f"{source}: expected a camera number, a video file, a stream address, or pictures such as "
        f"frame%03d.png, found {found}"
    )
