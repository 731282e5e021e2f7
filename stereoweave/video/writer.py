"""Writing of the parts of a video, and joining them with the sound.

A part is a NUT file, which stores frame times of any time base exactly. Parts are joined packet by packet:
nothing is encoded twice, and sound is copied bit for bit.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from fractions import Fraction
from heapq import merge
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

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
from stereoweave.io.files import replacing

if TYPE_CHECKING:  # PyAV's types have parameters that its classes lack
    from av.packet import Packet

    AnyPacket = Packet[Any]
else:
    from av.packet import Packet as AnyPacket

CONTAINERS = {".mp4": "mp4", ".mkv": "matroska", ".mov": "mov"}
# Sound starts before 0 by its decoder's priming samples; by default the muxer would delay the whole video.
_EXACT_TIMES = {"avoid_negative_ts": "disabled"}
# Time unit of stream starts: a multiple of 90 kHz, 48 kHz and the numerators of rates such as 30000/1001.
_EXACT_STARTS = {"movie_timescale": "720000"}
# Enough to include the first packet of every audio stream.
_TRIED_PACKETS = 64
# swscale's default conversion darkens everything by a level or two.
_EXACT_COLOURS = Interpolation.BICUBIC | Interpolation.ACCURATE_RND

Picture = UInt8[np.ndarray, "h w 3"] | UInt16[np.ndarray, "h w"]


class Encoding(NamedTuple):
    """Settings of the encoder, in FFmpeg's terms."""

    codec: str
    pixel_format: str
    colour_range: ColorRange
    options: Mapping[str, str]


# Plays everywhere and looks like the input. Without B-frames (bf), parts can be joined at any times. With
# macroblock-tree rate control (mbtree), 1 part in 500 differed between runs on the same frames, even with one
# thread (x264 165); without it, 0 of 4,447.
H264 = Encoding(
    "libx264", "yuv420p", ColorRange.MPEG, {"crf": "17", "preset": "fast", "bf": "0", "mbtree": "0"}
)
# Lossless; as archives do, every frame is a key frame with checksums.
GREY16 = Encoding("ffv1", "gray16le", ColorRange.JPEG, {"level": "3", "g": "1", "slicecrc": "1"})


class Packing(NamedTuple):
    """Frame packing: Matroska's stereo mode, and H.264's number, None where that would swap the eyes."""

    stereo_mode: str
    frame_packing: int | None


@dataclass(frozen=True, kw_only=True)
class Recorder:
    """Writes the parts of a video and joins them.

    Attributes:
        encoding: H264, or GREY16 for 16-bit grey.
        time_base: Unit of all frame times, in seconds.
        rate: Frames per second; sets the duration of the last frame.
        packing: Frame packing of two views, if any.
        threads: Number of threads.
    """

    encoding: Encoding
    time_base: Fraction
    rate: Fraction
    packing: Packing | None = None
    threads: int = 1

    def write_part(self, path: Path, pictures: Iterable[tuple[Fraction, Picture]]) -> None:
        """Write images of one size, each with its time in seconds, as a NUT file.

        H.264 halves the resolution of colour, so an odd size is padded by repeating the last row or column.
        """
        with av.open(str(path), "w", format="nut") as part:
            stream = None
            for time_s, picture in pictures:
                frame = _make_frame(picture)
                frame.pts, frame.time_base = round(time_s / self.time_base), self.time_base
                stream = stream or self._add_stream(part, frame)
                part.mux(stream.encode(frame))
            if stream:
                part.mux(stream.encode())

    def join(self, parts: Sequence[Path], sound: Path | None, out: Path, metadata: Mapping[str, str]) -> None:
        """Join all parts with all sound of the file `sound`; copies every packet unchanged.

        MP4 and MOV store all times exactly; Matroska rounds to milliseconds.

        Args:
            parts: Files of `write_part`, in order.
            sound: The video whose sound and start time are copied; None for a silent video.
            out: The file to write; its ending must be in `CONTAINERS`.
            metadata: The file's metadata.
        """
        with ExitStack() as stack:
            temporary = stack.enter_context(replacing(out))
            options = _EXACT_TIMES | (_EXACT_STARTS if out.suffix.lower() in (".mp4", ".mov") else {})
            container = stack.enter_context(av.open(str(temporary), "w", options=options))
            container.metadata.update(metadata)
            first = stack.enter_context(av.open(str(parts[0])))
            stream = container.add_stream_from_template(first.streams.video[0], opaque=True)
            if self.packing:
                stream.metadata["stereo_mode"] = self.packing.stereo_mode
            start_s, sound_packets = Fraction(0), []
            if sound:
                source = stack.enter_context(av.open(str(sound)))
                start_s = _find_start_s(source.streams.best("video"))
                sound_packets = [_read_sound(source, _copy_sound_streams(source, container))]
            # In order of time, because the muxer buffers packets that are ahead of the other streams.
            for packet in merge(
                self._read_packets(parts, stream, start_s), *sound_packets, key=_decoding_time_s
            ):
                container.mux(packet)

    def _add_stream(self, part: OutputContainer, frame: VideoFrame) -> VideoStream:
        """Add a stream for frames like this one, with the colours of HD video (BT.709)."""
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

    def _read_packets(
        self, parts: Sequence[Path], stream: VideoStream, start_s: Fraction
    ) -> Iterator[AnyPacket]:
        """Yield the packets of all parts for one stream, delayed by `start_s`."""
        for path in parts:
            with av.open(str(path)) as part:
                for packet in _drop_empty(part.demux(video=0)):
                    packet.stream = stream
                    # Without B-frames, decoding order is display order.
                    packet.pts = packet.dts = (packet.pts or 0) + round(start_s / packet.time_base)
                    packet.duration = round(1 / self.rate / packet.time_base)
                    yield packet


def check_container(path: Path, sound: Path | None) -> None:
    """Raise StereoweaveError unless `path` has the ending of a container that can hold the file's sound."""
    if path.suffix.lower() not in CONTAINERS:
        raise StereoweaveError(
            f"{path}: expected the ending of a video, {', '.join(CONTAINERS)}, found {path.suffix!r}"
        )
    if sound is None or _can_hold(path.suffix, sound):
        return
    with av.open(str(sound)) as source:
        codecs = ", ".join(sorted({stream.codec_context.name for stream in source.streams.audio}))
    others = [ending for ending in CONTAINERS if _can_hold(ending, sound)]
    remedy = f"{others[0]} holds it" if others else "convert the sound first, to FLAC for instance"
    raise StereoweaveError(
        f"{path}: expected sound that {path.suffix} can hold, found {codecs} in {sound}; {remedy}"
    )


def _make_frame(picture: Picture) -> VideoFrame:
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


def _can_hold(ending: str, sound: Path) -> bool:
    """Test whether a container with this ending can hold a file's sound, by muxing its beginning."""
    container = CONTAINERS[ending.lower()]
    try:
        with av.open(str(sound)) as source, av.open(BytesIO(), "w", format=container) as output:
            output.mux(list(islice(_read_sound(source, _copy_sound_streams(source, output)), _TRIED_PACKETS)))
    except ValueError:  # raised by both PyAV and FFmpeg for sound that the container cannot hold
        return False
    return True


def _copy_sound_streams(source: InputContainer, output: OutputContainer) -> dict[int, AudioStream]:
    """Add a stream to a video for each audio stream of the source; by the source's indices."""
    streams = {}
    for stream in source.streams.audio:
        streams[stream.index] = copy = output.add_stream_from_template(stream, opaque=True)
        copy.metadata.update(stream.metadata)
        copy.disposition = stream.disposition
    return streams


def _read_sound(source: InputContainer, streams: Mapping[int, AudioStream]) -> Iterator[AnyPacket]:
    """Yield the audio packets of a source for the new streams."""
    with suppress(FFmpegError):  # the file breaks off, which `StereoVideo` reports
        for packet in _drop_empty(source.demux(*source.streams.audio)):
            packet.stream = streams[packet.stream_index]
            yield packet


def _find_start_s(stream: Stream | None) -> Fraction:
    """Return the time of the first frame, in seconds of its file's clock."""
    return (stream.start_time or 0) * (stream.time_base or Fraction(0)) if stream else Fraction(0)


def _drop_empty(packets: Iterable[AnyPacket]) -> Iterator[AnyPacket]:
    """Drop the empty packets at the end of a demuxer."""
    return (packet for packet in packets if packet.size)


def _decoding_time_s(packet: AnyPacket) -> Fraction:
    return packet.time_base * (packet.dts or 0)
