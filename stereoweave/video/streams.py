"""Opening, listing and decoding of the streams of a video file."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from stereoweave.errors import FormatError, require_extra
from stereoweave.io.files import reading
from stereoweave.io.unreadable import check_readable

if TYPE_CHECKING:
    import av

# Type of the first box in an MP4 or MOV file, which follows the four bytes of the box's length.
_MP4_BOXES = b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot"

# Formats of files that name others, which FFmpeg would read wherever they lie, and how the usual ones begin.
_REFERRING = {"hls", "dash", "concat", "imf"}
_PLAYLISTS = b"#EXTM3U", b"ffconcat"

# FFmpeg's AV_DISPOSITION_ATTACHED_PIC and AV_DISPOSITION_TIMED_THUMBNAILS.
_SINGLE_PICTURES = 0x400 | 0x800


class StreamFacts(NamedTuple):
    """What a file says about one of its video streams.

    Attributes:
        number: Index of the stream among all streams of the file.
        size_px: Width and height of its frames.
        rate: Frames per second.
        plane: FFmpeg's tag `stereo_mode`, such as "left_2"; "" if there is none.
    """

    number: int
    size_px: tuple[int, int]
    rate: Fraction
    plane: str


def list_video_streams(path: Path) -> list[StreamFacts]:
    """Return the video streams of a file, without those that hold a cover or nothing.

    Raises:
        FormatError: The file cannot be opened.
    """
    with open_container(path) as container:
        return [
            StreamFacts(
                number=stream.index,
                size_px=(stream.codec_context.width, stream.codec_context.height),
                rate=stream.guessed_rate or Fraction(25),
                plane=stream.metadata.get("stereo_mode", ""),
            )
            for stream in container.streams.video
            if stream.codec_context is not None
            and stream.codec_context.width * stream.codec_context.height > 0
            and not stream.disposition & _SINGLE_PICTURES
        ]


def open_container(path: Path) -> "av.container.InputContainer":
    """Open a video file. Raises FormatError."""
    check_readable(path, "a video")
    refuse_playlist(path)
    with require_extra("video", f"{path}: reading video needs PyAV"):
        import av
    own_content = ",".join(sorted(av.formats_available - _REFERRING))
    try:
        return av.open(str(path), metadata_errors="replace", options={"format_whitelist": own_content})
    except av.error.FFmpegError as error:
        raise FormatError(f"{path}: expected a video, found {_describe_unopened(path, error)}") from error


def find_sound_streams(container: "av.container.InputContainer") -> "list[av.AudioStream]":
    """Return the streams of sound whose codecs FFmpeg knows; it cannot copy others."""
    return [stream for stream in container.streams.audio if stream.codec_context is not None]


def refuse_playlist(path: Path) -> None:
    """Raise FormatError if a file is a playlist, or is unreadable."""
    with reading(path, "a video"), path.open("rb") as file:
        beginning = file.read(max(map(len, _PLAYLISTS)))
    if beginning.startswith(_PLAYLISTS):
        raise FormatError(
            f"{path}: expected a video, found a playlist, which names other files; give the video itself"
        )


@contextmanager
def open_stream(
    path: Path, index: int | None = None
) -> Iterator[tuple["av.container.InputContainer", "av.VideoStream"]]:
    """Open a file and its stream of this index, or the one that FFmpeg finds best. Raises FormatError."""
    with open_container(path) as container:
        import av

        stream = container.streams.best("video") if index is None else container.streams[index]
        if not isinstance(stream, av.VideoStream) or stream.codec_context is None:
            raise FormatError(f"{path}: expected a video, found a file without a decodable video track")
        # With several threads, FFmpeg conceals damage in H.264 poorly, if at all, and not reproducibly.
        stream.codec_context.thread_count = 1
        stream.codec_context.copy_opaque = True  # passes the packet's rank on to the frame
        if stream.codec_context.name == "hevc":
            stream.codec_context.options = {"view_ids": "-1"}  # both views of a spatial video
        if stream.codec_context.name == "mjpeg":
            # By default, the decoder returns truncated pictures, grey at the bottom, as if they were intact.
            stream.codec_context.options = {"err_detect": "explode"}
        yield container, stream


def decode(container: "av.container.InputContainer", stream: "av.VideoStream") -> Iterator["av.VideoFrame"]:
    """Yield the decoded frames in display order, up to the end of the file or unrecoverable damage."""
    import av

    ranks = count()
    with suppress(av.error.FFmpegError):
        for packet in container.demux(stream):
            if is_frame(packet):
                packet.opaque = next(ranks)
            with suppress(av.error.FFmpegError):
                yield from stream.decode(packet)
    # If the file was read to its end, the decoder is already flushed and raises an error.
    with suppress(av.error.FFmpegError):
        yield from stream.decode(None)


def drop_corrupt(frames: Iterator["av.VideoFrame"]) -> Iterator["av.VideoFrame"]:
    """Return the frames without those that the decoder marks as damaged."""
    return (frame for frame in frames if not frame.is_corrupt)


def is_frame(packet: "av.Packet[Any]") -> bool:
    """Return whether a packet holds a frame to be shown."""
    return bool(packet.size) and not packet.is_discard


def describe_error(error: "av.error.FFmpegError") -> str:
    """Return FFmpeg's own words for an error, in lower case."""
    return (error.strerror or "error in FFmpeg").lower()


def _describe_unopened(path: Path, error: "av.error.FFmpegError") -> str:
    """Describe what was found instead of a video, for an error message."""
    beginning = b""
    with suppress(OSError), path.open("rb") as file:
        beginning = file.read(8)
        if not beginning:
            return "an empty file"
    found = f"none that FFmpeg can open ({describe_error(error)})"
    if beginning[4:] in _MP4_BOXES:
        found += "; if the file was cut off, its index is lost: record or download it again"
    return found
