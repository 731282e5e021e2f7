"""Recognition of MVC, the H.264 of 3-D Blu-rays and AVCHD 3D, of which FFmpeg decodes the base view alone."""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from stereoweave.errors import FormatError
from stereoweave.video.streams import open_container

# A disc repeats its parameter sets at least once a second, in every access unit that can be decoded alone.
_MOST_PACKETS, _MOST_UNITS = 400, 1000
# Types of NAL units (ITU-T H.264, table 7-1) and profiles of Annex H: Multiview High and Stereo High.
_SUBSET_PARAMETERS, _EXTENSION_SLICE = 15, 20
_MULTIVIEW_PROFILES = (118, 128)
_IS_SVC = 0x80


def check_not_mvc(path: Path) -> None:
    """Raise a FormatError if a video holds its second view as MVC, or if the file cannot be opened.

    Otherwise a file whose container declares a frame sequence, as some programs write them, would be read as
    one, and its base view alone as a pair.
    """
    if _holds_mvc(path):
        raise FormatError(
            f"{path}: expected views that can be decoded, found MVC (H.264 Stereo High, as on 3-D Blu-rays), "
            "of which FFmpeg decodes one view alone; convert it to side by side by a program that decodes "
            "both, such as BD3D2MK3D or FRIM"
        )


def _holds_mvc(path: Path) -> bool:
    with open_container(path) as container:
        import av

        streams = [stream for stream in container.streams.video if _is_h264(stream)]
        if not streams:
            return False
        said = {stream.index: stream.codec_context.extradata or b"" for stream in streams}
        if any(b"mvcC" in description for description in said.values()):
            return True
        try:
            for packet in islice(container.demux(streams), _MOST_PACKETS):
                units = _split_units(bytes(packet), _read_prefix_bytes(said[packet.stream.index]))
                if any(map(_is_of_second_view, islice(units, _MOST_UNITS))):
                    return True
        except av.error.FFmpegError:
            pass
    return False


def _is_h264(stream: object) -> bool:
    context = getattr(stream, "codec_context", None)
    return context is not None and context.name == "h264"


def _read_prefix_bytes(description: bytes) -> int:
    """Return how many bytes state the length of a NAL unit; 0 for units between start codes."""
    return (description[4] & 3) + 1 if len(description) > 4 and description[0] == 1 else 0


def _split_units(content: bytes, prefix_bytes: int) -> Iterator[bytes]:
    """Yield the beginning of each NAL unit."""
    start = 0
    while prefix_bytes and start + prefix_bytes < len(content):
        begin = start + prefix_bytes
        yield content[begin : begin + 4]
        start = begin + int.from_bytes(content[start:begin])
    while not prefix_bytes and (start := content.find(b"\0\0\1", start)) >= 0:
        yield content[start + 3 : start + 7]
        start += 3


def _is_of_second_view(unit: bytes) -> bool:
    if len(unit) < 2:
        return False
    kind = unit[0] & 31
    if kind == _SUBSET_PARAMETERS:
        return unit[1] in _MULTIVIEW_PROFILES
    return kind == _EXTENSION_SLICE and not unit[1] & _IS_SVC
