"""Write a video in parts, then join the parts and add the sound.

A part is a NUT file, which stores frame times exactly for any time base. Parts are joined packet by packet,
so nothing is encoded twice, and sound is copied bit for bit.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from fractions import Fraction
from heapq import merge
from io import BytesIO
from itertools import islice
from math import inf
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

from stereoweave.errors import Remedy, StereoweaveError
from stereoweave.io.files import replacing
from stereoweave.video.mp4_marks import VideoMarks, show_bounds, write_marks
from stereoweave.video.streams import find_sound_streams, open_container

if TYPE_CHECKING:  # PyAV's types have parameters that its classes lack
    from av.packet import Packet

    AnyPacket = Packet[Any]
else:
    from av.packet import Packet as AnyPacket

CONTAINERS = {".mp4": "mp4", ".mkv": "matroska", ".mov": "mov"}
# Sound starts before 0, with the priming samples of its decoder. By default, the muxer would therefore delay
# the whole video.
_EXACT_TIMES = {"avoid_negative_ts": "disabled"}
# Time scale of stream starts: a multiple of 90 kHz, 48 kHz and the numerators of rates such as 30000/1001.
_EXACT_STARTS = {"movie_timescale": "720000"}
# Number of packets that includes the first packet of every audio stream.
_TRIED_PACKETS = 64
# swscale's default conversion darkens everything by a level or two.
_EXACT_COLOURS = Interpolation.BICUBIC | Interpolation.ACCURATE_RND

Picture = UInt8[np.ndarray, "h w 3"] | UInt16[np.ndarray, "h w 3"] | UInt16[np.ndarray, "h w"]


class Encoding(NamedTuple):
    """Encoder settings, as FFmpeg names them, and the largest width and height that the encoder takes."""

    codec: str
    pixel_format: str
    colour_range: ColorRange
    options: Mapping[str, str]
    most_px: float = inf


# Plays everywhere and looks like the input. Without B-frames (bf), parts can be joined at any frame. With
# macroblock-tree rate control (mbtree), 1 part in 500 differed between runs on the same frames, even with one
# thread (x264 165); without it, 0 of 4,447.
H264 = Encoding(
    "libx264", "yuv420p", ColorRange.MPEG, {"crf": "16", "preset": "faster", "bf": "0", "mbtree": "0"}, 16384
)
# The same in 10 bits; parts begin with frames to which no earlier ones are related.
HEVC10 = Encoding(
    "libx265",
    "yuv420p10le",
    ColorRange.MPEG,
    {"crf": "16", "preset": "faster", "x265-params": "bframes=0:open-gop=0:log-level=error"},
)
# Values of depth must not change by more than a few steps.
DEPTH10 = HEVC10._replace(options=dict(HEVC10.options) | {"crf": "8"})
# Lossless. As is usual in archives, every frame is a key frame with checksums.
GREY16 = Encoding("ffv1", "gray16le", ColorRange.JPEG, {"level": "3", "g": "1", "slicecrc": "1"})


class Colours(NamedTuple):
    """Meaning of a video's colours, by FFmpeg's numbers: primaries, transfer function and matrix."""

    primaries: int
    transfer: int
    matrix: int


BT709 = Colours(ColorPrimaries.BT709, ColorTrc.BT709, Colorspace.ITU709)
# The value of both colour planes where there is no colour, in 10 bits.
_NO_COLOUR_10 = 512
# Apple's players accept HEVC only under this name.
_HEVC_TAG = "hvc1"


class Packing(NamedTuple):
    """Frame packing, as named by Matroska and as numbered by H.264.

    The number is None if it would make players swap the eyes.
    """

    stereo_mode: str
    frame_packing: int | None


@dataclass(frozen=True, kw_only=True)
class Recorder:
    """Encoder that writes the parts of a video and joins them.

    Attributes:
        encoding: H264, HEVC10 for 10 bits, or DEPTH10 or GREY16 for grey of 10 or 16 bits.
        time_base: Unit of all frame times, in seconds.
        rate: Frames per second; sets the duration of the last frame.
        packing: Frame packing to declare in the file, if any. HEVC itself cannot.
        colours: Meaning of the colours.
        pixel_aspect: Width of a pixel divided by its height. FFV1 cannot say it.
        threads: Number of encoder threads.
    """

    encoding: Encoding
    time_base: Fraction
    rate: Fraction
    packing: Packing | None = None
    colours: Colours = BT709
    pixel_aspect: Fraction = Fraction(1)
    threads: int = 1

    def check_size(self, width_px: int, height_px: int) -> None:
        """Raise StereoweaveError if the encoder does not take frames of this size."""
        if max(width_px, height_px) > self.encoding.most_px:
            raise StereoweaveError(
                f"expected output frames of at most {self.encoding.most_px} px per side for H.264, found "
                f"{width_px}x{height_px} px",
                remedy=Remedy("write HEVC, in 10 bits", ("bits", "depth10")),
            )

    def write_part(self, path: Path, pictures: Iterable[tuple[Fraction, Picture]]) -> None:
        """Write images of the same size, each with its time in seconds, to a NUT file.

        Colours of 16 bits reach from 0 to 65280; grey is written as it is, in 10 or 16 bits. H.264 and HEVC
        halve the colour resolution, so an odd size is padded by repeating the last row or column.
        """
        with av.open(str(path), "w", format="nut") as part:
            stream = None
            for time_s, picture in pictures:
                frame = self._make_frame(picture)
                frame.pts, frame.time_base = round(time_s / self.time_base), self.time_base
                stream = stream or self._add_stream(part, frame)
                part.mux(stream.encode(frame))
            if stream:
                part.mux(stream.encode())

    def join(
        self,
        parts: Sequence[Path],
        sound: Path | None,
        out: Path,
        metadata: Mapping[str, str],
        marks: VideoMarks | None = None,
    ) -> None:
        """Join all parts with all audio streams in the file `sound`, copying every packet unchanged.

        MP4 and MOV store all times exactly; Matroska rounds them to milliseconds.

        Args:
            parts: Files written by `write_part`, in order.
            sound: Video whose sound and start time are copied; None for a silent video.
            out: Output file; its extension must be in `CONTAINERS`.
            metadata: Metadata of the output file.
            marks: What the file says about its views and cameras. Matroska holds the packing that
                `packing` declares, and the bounds of a panorama.
        """
        with replacing(out) as temporary:
            if out.suffix.lower() != ".mkv":
                self._mux(parts, sound, temporary, metadata)
                if marks is not None:
                    write_marks(temporary, marks)
            elif marks is not None and marks.is_panorama:
                self._mux_panorama(parts, sound, temporary, metadata, marks)
            else:
                self._mux(parts, sound, temporary, metadata)

    def _mux_panorama(
        self,
        parts: Sequence[Path],
        sound: Path | None,
        out: Path,
        metadata: Mapping[str, str],
        marks: VideoMarks,
    ) -> None:
        """Join all parts in a Matroska file with a projection, which FFmpeg copies from a marked MP4 file."""
        marked = out.with_suffix(".mp4")
        try:
            self._mux(parts, None, marked, {})
            write_marks(marked, show_bounds(marks))
            self._mux([marked], sound, out, metadata)
        finally:
            marked.unlink(missing_ok=True)

    def _mux(self, parts: Sequence[Path], sound: Path | None, out: Path, metadata: Mapping[str, str]) -> None:
        """Join all parts with the sound of a file, in a file that nobody reads yet."""
        with ExitStack() as stack:
            options = _EXACT_TIMES | (_EXACT_STARTS if out.suffix.lower() in (".mp4", ".mov") else {})
            container = stack.enter_context(av.open(str(out), "w", options=options))
            container.metadata.update(metadata)
            first = stack.enter_context(av.open(str(parts[0])))
            stream = container.add_stream_from_template(first.streams.video[0], opaque=True)
            if stream.codec_context.name == "hevc" and out.suffix.lower() != ".mkv":
                stream.codec_context.codec_tag = _HEVC_TAG
            if self.packing:
                stream.metadata["stereo_mode"] = self.packing.stereo_mode
            start_s, sound_packets = Fraction(0), []
            if sound:
                source = stack.enter_context(open_container(sound))
                start_s = _find_start_s(source.streams.best("video"))
                sound_packets = [_read_sound(source, _copy_sound_streams(source, container))]
            # Merge the packets by time, because the muxer buffers packets that are ahead of other streams.
            for packet in merge(
                self._read_packets(parts, stream, start_s), *sound_packets, key=_decoding_time_s
            ):
                container.mux(packet)

    def _add_stream(self, part: OutputContainer, frame: VideoFrame) -> VideoStream:
        """Add a video stream for frames of the same size as `frame`."""
        self.check_size(frame.width, frame.height)
        options = dict(self.encoding.options)
        if self.encoding.codec == "libx265":
            options["x265-params"] += f":pools={self.threads}"
        elif self.packing and self.packing.frame_packing is not None:
            options["x264-params"] = f"frame-packing={self.packing.frame_packing}"
        stream = part.add_stream(self.encoding.codec, self.rate, options, time_base=self.time_base)
        assert isinstance(stream, VideoStream)
        stream.width, stream.height, stream.pix_fmt = frame.width, frame.height, self.encoding.pixel_format
        stream.thread_count = self.threads
        if self.pixel_aspect != 1:
            stream.codec_context.sample_aspect_ratio = self.pixel_aspect
        stream.color_range, stream.colorspace = self.encoding.colour_range, self.colours.matrix
        stream.color_primaries, stream.color_trc = self.colours.primaries, self.colours.transfer
        return stream

    def _make_frame(self, picture: Picture) -> VideoFrame:
        if self.encoding.pixel_format == GREY16.pixel_format:
            return VideoFrame.from_ndarray(picture.astype(np.uint16, copy=False), GREY16.pixel_format)
        height, width = picture.shape[:2]
        even: Any = cv2.copyMakeBorder(picture, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
        if even.ndim == 2:
            # FFmpeg would take grey for full range, and convert it.
            colourless = np.full((even.shape[0] // 2, even.shape[1]), _NO_COLOUR_10, np.uint16)
            return VideoFrame.from_ndarray(np.vstack([even, colourless]), self.encoding.pixel_format)
        return VideoFrame.from_ndarray(even, "rgb24" if even.dtype == np.uint8 else "rgb48le").reformat(
            format=self.encoding.pixel_format,
            src_color_range=ColorRange.JPEG,
            dst_color_range=ColorRange.MPEG,
            dst_colorspace=self.colours.matrix,
            interpolation=_EXACT_COLOURS,
        )

    def _read_packets(
        self, parts: Sequence[Path], stream: VideoStream, start_s: Fraction
    ) -> Iterator[AnyPacket]:
        """Yield the packets of all parts, assigned to `stream` and delayed by `start_s`."""
        for path in parts:
            with av.open(str(path)) as part:
                for packet in _drop_empty(part.demux(video=0)):
                    packet.stream = stream
                    # Without B-frames, decoding order is display order.
                    packet.pts = packet.dts = (packet.pts or 0) + round(start_s / packet.time_base)
                    packet.duration = round(1 / self.rate / packet.time_base)
                    yield packet


def check_container(path: Path, sound: Path | None) -> None:
    """Raise StereoweaveError unless the extension of `path` selects a container that can hold the sound."""
    if path.suffix.lower() not in CONTAINERS:
        raise StereoweaveError(
            f"{path}: expected the file extension {' or '.join(CONTAINERS)}, found {path.suffix or 'none'}"
        )
    if sound is None or _can_hold(path.suffix, sound):
        return
    with open_container(sound) as source:
        codecs = ", ".join(sorted({stream.codec_context.name for stream in find_sound_streams(source)}))
    others = [ending for ending in CONTAINERS if _can_hold(ending, sound)]
    remedy = f"use {others[0]} instead" if others else "convert the sound first, for example to FLAC"
    raise StereoweaveError(
        f"{path}: expected sound that {path.suffix} can hold, found {codecs} in {sound}; {remedy}"
    )


def _can_hold(ending: str, sound: Path) -> bool:
    """Return whether a container with this extension can hold a file's sound, as tested by muxing."""
    container = CONTAINERS[ending.lower()]
    try:
        with open_container(sound) as source, av.open(BytesIO(), "w", format=container) as output:
            output.mux(list(islice(_read_sound(source, _copy_sound_streams(source, output)), _TRIED_PACKETS)))
    except ValueError:  # raised by both PyAV and FFmpeg for sound that the container cannot hold
        return False
    return True


def _copy_sound_streams(source: InputContainer, output: OutputContainer) -> dict[int, AudioStream]:
    """Add each audio stream in the source to the output, and return the new streams by source index."""
    streams = {}
    for stream in find_sound_streams(source):
        streams[stream.index] = copy = output.add_stream_from_template(stream, opaque=True)
        copy.metadata.update(stream.metadata)
        copy.disposition = stream.disposition
    return streams


def _read_sound(source: InputContainer, streams: Mapping[int, AudioStream]) -> Iterator[AnyPacket]:
    """Yield the audio packets of a source, assigned to the new streams."""
    with suppress(FFmpegError):  # a file that ends early is reported by `StereoVideo`
        for packet in _drop_empty(source.demux(*find_sound_streams(source))):
            packet.stream = streams[packet.stream_index]
            yield packet


def _find_start_s(stream: Stream | None) -> Fraction:
    """Return the time of the first frame of a stream, in seconds on the clock of its file."""
    return (stream.start_time or 0) * (stream.time_base or Fraction(0)) if stream else Fraction(0)


def _drop_empty(packets: Iterable[AnyPacket]) -> Iterator[AnyPacket]:
    """Yield all packets except the empty packets that a demuxer emits at the end."""
    return (packet for packet in packets if packet.size)


def _decoding_time_s(packet: AnyPacket) -> Fraction:
    return packet.time_base * (packet.dts or 0)
