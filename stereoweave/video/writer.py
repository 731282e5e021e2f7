"""Films written in parts, so that one that was interrupted goes on, and joined with the sound they came with.

A part is a NUT file, which holds frame times of any time base exactly. Parts are joined packet by packet:
nothing is encoded twice, and sound is copied bit for bit.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from heapq import merge
from io import BytesIO
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from zipfile import BadZipFile

import av
import cv2
import numpy as np
from av.audio.stream import AudioStream
from av.container import InputContainer, OutputContainer
from av.error import FFmpegError
from av.stream import Stream
from av.video.frame import VideoFrame
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc, Interpolation
from av.video.stream import VideoStream
from jaxtyping import UInt8, UInt16

from stereoweave.errors import StereoweaveError
from stereoweave.io.files import make_folder, remove_leftovers, replacing

if TYPE_CHECKING:  # PyAV's types have parameters that its classes lack
    from av.packet import Packet

    AnyPacket = Packet[Any]
else:
    from av.packet import Packet as AnyPacket

CONTAINERS = {".mp4": "mp4", ".mkv": "matroska", ".mov": "mov"}
# Sound begins before 0 by what its decoder throws away: the muxer would rather make the whole film late.
_EXACT_TIMES = {"avoid_negative_ts": "disabled"}
# When streams begin is told in these; a whole number for 90 kHz, 48 kHz, and rates such as 30000/1001.
_EXACT_STARTS = {"movie_timescale": "720000"}
# Enough for the first ones of all streams of sound.
_TRIED_PACKETS = 64
# swscale's plain conversion takes a level or two from everything.
_EXACT_COLOURS = Interpolation.BICUBIC | Interpolation.ACCURATE_RND

Picture = UInt8[np.ndarray, "h w 3"] | UInt16[np.ndarray, "h w"]


class Encoding(NamedTuple):
    """How pictures become packets, in FFmpeg's words."""

    codec: str
    pixel_format: str
    colour_range: ColorRange
    options: Mapping[str, str]


# What every player takes, hard to tell from what went in. Without frames that are coded out of turn (bf),
# parts can be joined whatever their times. With x264's plans by blocks (mbtree), one part in 500 came out
# otherwise from the very same frames, on one thread too (x264 165); without, none of 4,447 did.
H264 = Encoding(
    "libx264", "yuv420p", ColorRange.MPEG, {"crf": "17", "preset": "fast", "bf": "0", "mbtree": "0"}
)
# Loses nothing; as archives have it, each frame a key frame with a checksum.
GREY16 = Encoding("ffv1", "gray16le", ColorRange.JPEG, {"level": "3", "g": "1", "slicecrc": "1"})


class Packing(NamedTuple):
    """How two views share a picture: Matroska's word, and H.264's number, None where that would swap eyes."""

    stereo_mode: str
    frame_packing: int | None


@dataclass(frozen=True, kw_only=True)
class Recorder:
    """Writes a film: its parts, and the whole of them.

    Attributes:
        encoding: H264, or GREY16 for pictures of 16-bit grey.
        time_base: The seconds that all frame times are multiples of.
        rate: Frames a second; it says how long the last one is shown.
        packing: How two views share each picture, if they do.
        threads: How many threads may be used.
    """

    encoding: Encoding
    time_base: Fraction
    rate: Fraction
    packing: Packing | None = None
    threads: int = 1

    def write_part(self, path: Path, pictures: Iterable[tuple[Fraction, Picture]]) -> None:
        """Writes pictures of one size, each with its time in seconds, as a NUT file.

        H.264 halves the colours' resolution: an odd picture gets its last row or column once more.
        """
        with av.open(str(path), "w", format="nut") as part:
            stream = None
            for time_s, picture in pictures:
                frame = _frame(picture)
                frame.pts, frame.time_base = round(time_s / self.time_base), self.time_base
                stream = stream or self._stream(part, frame)
                part.mux(stream.encode(frame))
            if stream:
                part.mux(stream.encode())

    def join(
        self, parts: Sequence[Path], sound: Path | None, film: Path, metadata: Mapping[str, str]
    ) -> None:
        """Writes the film of all parts, with all sound of the file `sound`, copying every packet as it is.

        MP4 and MOV keep all times exactly; Matroska counts in whole milliseconds.

        Args:
            parts: What `write_part` wrote, in their order.
            sound: The film whose sound is copied, and which the new one begins as late as; None for silence.
            film: The file to write, of an ending in `CONTAINERS`.
            metadata: What the file says about itself.
        """
        with ExitStack() as stack:
            temporary = stack.enter_context(replacing(film))
            options = _EXACT_TIMES | (_EXACT_STARTS if film.suffix.lower() in (".mp4", ".mov") else {})
            container = stack.enter_context(av.open(str(temporary), "w", options=options))
            container.metadata.update(metadata)
            first = stack.enter_context(av.open(str(parts[0])))
            stream = container.add_stream_from_template(first.streams.video[0], opaque=True)
            if self.packing:
                stream.metadata["stereo_mode"] = self.packing.stereo_mode
            start_s, flows = Fraction(0), []
            if sound:
                source = stack.enter_context(av.open(str(sound)))
                start_s = _start_s(source.streams.best("video"))
                flows = [_sound(source, _copied(source, container))]
            # In the order of their times: the muxer holds whatever comes ahead of the other flow.
            for packet in merge(self._pictures(parts, stream, start_s), *flows, key=_time_s):
                container.mux(packet)

    def _stream(self, part: OutputContainer, frame: VideoFrame) -> VideoStream:
        """A stream for frames like this one, whose colours are those of HD video (BT.709)."""
        options = dict(self.encoding.options)
        if self.packing and self.packing.frame_packing is not None:
            options["x264-params"] = f"frame-packing={self.packing.frame_packing}"
        stream = part.add_stream(self.encoding.codec, self.rate, options, time_base=self.time_base)
        assert isinstance(stream, VideoStream)
        stream.width, stream.height, stream.pix_fmt = frame.width, frame.height, self.encoding.pixel_format
        stream.thread_count = self.threads
        stream.color_range, stream.colorspace = self.encoding.colour_range, Colorspace.ITU709
        stream.color_primaries, stream.color_trc = ColorPrimaries.BT709, ColorTrc.BT709
        return stream

    def _pictures(self, parts: Sequence[Path], stream: VideoStream, start_s: Fraction) -> Iterator[AnyPacket]:
        """The packets of all parts, for one stream, later by `start_s`."""
        for path in parts:
            with av.open(str(path)) as part:
                for packet in _filled(part.demux(video=0)):
                    packet.stream = stream
                    # Without frames coded out of turn, they are decoded when they are shown.
                    packet.pts = packet.dts = (packet.pts or 0) + round(start_s / packet.time_base)
                    packet.duration = round(1 / self.rate / packet.time_base)
                    yield packet


def check_film(path: Path, sound: Path | None) -> None:
    """A StereoweaveError unless `path` has the ending of a film that can hold the sound of that file."""
    if path.suffix.lower() not in CONTAINERS:
        raise StereoweaveError(
            f"{path}: expected the ending of a film, {', '.join(CONTAINERS)}, found {path.suffix!r}"
        )
    if sound is None or _holds(path.suffix, sound):
        return
    with av.open(str(sound)) as source:
        codecs = ", ".join(sorted({stream.codec_context.name for stream in source.streams.audio}))
    others = [ending for ending in CONTAINERS if _holds(ending, sound)]
    remedy = f"{others[0]} holds it" if others else "convert it first, to FLAC for instance"
    raise StereoweaveError(
        f"{path}: expected sound that {path.suffix} can hold, found {codecs} in {sound}; {remedy}"
    )


class Parts:
    """The finished parts of a film, each with the state in which its maker went on.

    Attributes:
        folder: Where the parts are.
        files: The finished ones, in their order.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.files = sorted(folder.glob("[0-9]*.nut"))
        if not self._state_file(len(self.files)).exists():  # a removal that was interrupted began with it
            self.files = []

    @contextmanager
    def next(self, state: Callable[[], Mapping[str, np.ndarray]]) -> Iterator[Path]:
        """The name to write the next part to, which is finished once the state after it is kept too."""
        number = len(self.files) + 1
        part = self.folder / f"{number:06}.nut"
        with replacing(part) as temporary:
            yield temporary
            with replacing(self._state_file(number)) as state_file:
                np.savez(state_file, allow_pickle=False, **state())
        self.files.append(part)
        self._state_file(number - 1).unlink(missing_ok=True)

    def state(self) -> dict[str, np.ndarray]:
        """The state after the last finished part."""
        file = self._state_file(len(self.files))
        with _undamaged(file), file.open("rb") as opened, np.load(opened) as arrays:
            return dict(arrays)

    def _state_file(self, number: int) -> Path:
        return self.folder / f"state-{number:06}.npz"


def parts_folder(film: Path) -> Path:
    """The folder in which a film grows."""
    return film.with_name(f"{film.name}.parts")


@contextmanager
def growing(film: Path, settings: Mapping[str, object]) -> Iterator[Parts]:
    """The parts of a film, to add to: removed when all went well; after an error the finished ones stay.

    Args:
        film: What the parts will become.
        settings: What it is made of, and how, in words that JSON has.

    Raises:
        StereoweaveError: There are parts that were made with other settings, or are damaged; or what went
            wrong, with a word about what stays.
    """
    folder = parts_folder(film)
    parts = Parts(folder)
    if parts.files:
        _check_settings(folder, settings)
        parts.state()
        remove_leftovers(folder)
    else:
        _clear(folder)
    make_folder(folder)
    try:
        if not parts.files:
            with replacing(_settings_file(folder)) as file:
                file.write_text(json.dumps(settings, indent=2))
        yield parts
    except BaseException as error:
        if not parts.files:
            _clear(folder)
        elif isinstance(error, OSError | FFmpegError | StereoweaveError):
            ours = error if isinstance(error, StereoweaveError) else StereoweaveError(str(error))
            raise ours.with_detail(
                f"what is finished stays in {folder}, and the same command goes on from there"
            ) from error
        raise
    _clear(folder)


def _settings_file(folder: Path) -> Path:
    return folder / "settings.json"


def _clear(folder: Path) -> None:
    """Removes what was written into a folder, and itself, if somebody else has nothing in it."""
    for file in chain(folder.glob("*.npz"), folder.glob("*.nut"), [_settings_file(folder)]):
        file.unlink(missing_ok=True)
    with suppress(OSError):
        folder.rmdir()


def _check_settings(folder: Path, settings: Mapping[str, object]) -> None:
    file = _settings_file(folder)
    with _undamaged(file):
        found = dict(json.loads(file.read_text()))
    other = [name for name, value in json.loads(json.dumps(settings)).items() if value != found.get(name)]
    if other:
        begun = ", ".join(_begun_with(name, found.get(name)) for name in other)
        raise StereoweaveError(
            f"{folder}: expected parts of the same video, found parts begun {begun}; "
            "remove that folder, or give the same settings again"
        )


def _begun_with(name: str, value: object) -> str:
    match value:
        case None | False:
            return f"without {name}"
        case True:
            return f"with {name}"
        case str() | int() | float():
            return f"with {name} {value}"
        case _:
            return f"with another {name}"


@contextmanager
def _undamaged(file: Path) -> Iterator[None]:
    """Turns what can be wrong with a file of a film's parts into one line."""
    try:
        yield
    except (OSError, ValueError, TypeError, EOFError, BadZipFile) as error:
        raise StereoweaveError(
            f"{file}: expected what an interrupted film goes on from, found none that can be read; "
            f"remove that folder: {file.parent}"
        ) from error


def _frame(picture: Picture) -> VideoFrame:
    if picture.ndim == 2:
        return VideoFrame.from_ndarray(picture.astype(np.uint16, copy=False), "gray16le")
    height, width = picture.shape[:2]
    even = cv2.copyMakeBorder(picture, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
    return VideoFrame.from_ndarray(even.astype(np.uint8, copy=False), "rgb24").reformat(
        format="yuv420p",
        src_color_range=ColorRange.JPEG,
        dst_color_range=ColorRange.MPEG,
        dst_colorspace=Colorspace.ITU709,
        interpolation=_EXACT_COLOURS,
    )


def _holds(ending: str, sound: Path) -> bool:
    """Whether a film of this ending can hold the sound of a file; the beginning of it is tried."""
    container = CONTAINERS[ending.lower()]
    try:
        with av.open(str(sound)) as source, av.open(BytesIO(), "w", format=container) as film:
            film.mux(list(islice(_sound(source, _copied(source, film)), _TRIED_PACKETS)))
    except ValueError:  # what both PyAV and FFmpeg say of sound that a container has no place for
        return False
    return True


def _copied(source: InputContainer, film: OutputContainer) -> dict[int, AudioStream]:
    """New streams of a film for the sound of a source, by their indices there."""
    streams = {}
    for stream in source.streams.audio:
        streams[stream.index] = copy = film.add_stream_from_template(stream, opaque=True)
        copy.metadata.update(stream.metadata)
        copy.disposition = stream.disposition
    return streams


def _sound(source: InputContainer, streams: Mapping[int, AudioStream]) -> Iterator[AnyPacket]:
    """The packets of sound of a source, for the streams that a film has for them."""
    with suppress(FFmpegError):  # where the file breaks off, of which `Footage` tells
        for packet in _filled(source.demux(*source.streams.audio)):
            packet.stream = streams[packet.stream_index]
            yield packet


def _start_s(stream: Stream | None) -> Fraction:
    """When the first picture is shown, in seconds of its file's clock."""
    return (stream.start_time or 0) * (stream.time_base or Fraction(0)) if stream else Fraction(0)


def _filled(packets: Iterable[AnyPacket]) -> Iterator[AnyPacket]:
    """Without the empty packets with which a demuxer ends."""
    return (packet for packet in packets if packet.size)


def _time_s(packet: AnyPacket) -> Fraction:
    return packet.time_base * (packet.dts or 0)
