"""Writing animations to MP4, GIF and animated WebP files."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from itertools import chain
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from stereoweave.errors import Remedy, StereoweaveError, require_extra
from stereoweave.io.decoding import count_frames
from stereoweave.io.files import replacing

Frames = Iterator[UInt8[np.ndarray, "h w 3"]]


def write_animation(path: str | Path, frames: Iterable[UInt8[np.ndarray, "h w 3"]], frame_ms: int) -> int:
    """Write frames as an animation, in the format given by the file extension: .mp4, .gif or .webp.

    Return the number of frames in the file. GIF and WebP merge frames that hardly differ into a longer one,
    so a file in which nothing moves has a single frame.

    GIF and WebP files repeat forever; all the frames are held in memory while such a file is written. An MP4
    file plays once and is written frame by frame; if its width or height is odd, the last column or row is
    repeated.

    Args:
        path: Output file, which is written atomically.
        frames: uint8 RGB [H, W, 3]; at least one, all of the same size.
        frame_ms: Duration of a frame. GIF rounds it to 10 ms.

    Raises:
        StereoweaveError: The extension is not one of these, there are no frames, their sizes differ or exceed
            the format's, PyAV is missing, or the disk is full.
    """
    write, most_px = _KINDS[check_animation_ending(path)]
    alike = _check_sizes(path, frames, most_px)
    with replacing(path) as temporary:
        return write(temporary, alike, frame_ms)


def check_animation_ending(path: str | Path) -> str:
    """Return an animation's file extension in lower case.

    Raises:
        StereoweaveError: No animation format has this extension, or it is .mp4 and PyAV is missing.
    """
    ending = Path(path).suffix.lower()
    if ending not in _KINDS:
        raise StereoweaveError(
            f"{path}: expected an animation file extension ({', '.join(_KINDS)}), "
            f"found {Path(path).suffix or 'none'}"
        )
    if ending == ".mp4":
        with require_video_extra("an MP4 file"):
            import av  # noqa: F401 - fails before the frames are rendered, which takes longer
    return ending


@contextmanager
def require_video_extra(what: str) -> Iterator[None]:
    """Turn the import error for a missing PyAV into an error that names the extra to install."""
    with require_extra("video", f"{what} needs PyAV"):
        yield


def _check_sizes(path: str | Path, frames: Iterable[UInt8[np.ndarray, "h w 3"]], most_px: int) -> Frames:
    """Check the first frame's size against the format's, and the others' against it as they are rendered.

    The first frame is rendered at once, so that its errors are raised before a file is created.
    """
    coming = iter(frames)
    first = next(coming, None)
    if first is None:
        raise StereoweaveError("frames: expected at least one frame, found none")
    height, width = first.shape[:2]
    if max(height, width) > most_px:
        raise StereoweaveError(
            f"{path}: expected frames of at most {most_px} px per side, found {width}x{height}",
            remedy=Remedy("limit their size", ("size_px",)),
        )
    return chain([first], (_check_size(first, frame) for frame in coming))


def _check_size(first: UInt8[np.ndarray, "h w 3"], frame: UInt8[np.ndarray, "h2 w2 3"]) -> np.ndarray:
    if frame.shape != first.shape:
        raise StereoweaveError(
            f"frames: expected frames of the same size, found {first.shape[1]}x{first.shape[0]} "
            f"and {frame.shape[1]}x{frame.shape[0]}"
        )
    return frame


def _write_mp4(path: Path, frames: Frames, frame_ms: int) -> int:
    import av
    from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

    first = _pad_to_even(next(frames))
    with av.open(path, "w", options={"movflags": "faststart"}) as film:
        stream = film.add_stream("libx264", rate=Fraction(1000, frame_ms), options={"crf": "18"})
        context = stream.codec_context
        context.height, context.width = first.shape[:2]
        context.pix_fmt = "yuv420p"  # the only format that every player supports
        # Without these tags in the file, players guess the colour space from the size, and colours shift.
        context.colorspace, context.color_range = Colorspace.ITU709, ColorRange.MPEG
        context.color_primaries, context.color_trc = ColorPrimaries.BT709, ColorTrc.BT709
        count = 0
        for frame in chain([first], map(_pad_to_even, frames)):
            count += 1
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
            in_yuv = picture.reformat(
                format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
            )
            film.mux(stream.encode(in_yuv))
        film.mux(stream.encode())
    return count


def _pad_to_even(frame: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    height, width = frame.shape[:2]
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), "edge")


def _write_gif(path: Path, frames: Frames, frame_ms: int) -> int:
    """Write a GIF with the first frame's palette for all frames, as separate palettes would cause flicker."""
    pictures = (Image.fromarray(frame) for frame in frames)
    first = next(pictures)
    # Pillow's most accurate and fastest method: 39.1 dB on the example; MEDIANCUT has 35.2 dB; both dithered.
    palette = first.quantize(256, method=Image.Quantize.FASTOCTREE)
    return _save(
        path, "GIF", (picture.quantize(palette=palette) for picture in chain([first], pictures)), frame_ms
    )


def _write_webp(path: Path, frames: Frames, frame_ms: int) -> int:
    return _save(path, "WEBP", (Image.fromarray(frame) for frame in frames), frame_ms, quality=90, method=4)


def _save(path: Path, kind: str, pictures: Iterator[Image.Image], frame_ms: int, **options: int) -> int:
    first = next(pictures)
    first.save(path, kind, save_all=True, append_images=pictures, duration=frame_ms, loop=0, **options)
    return count_frames(path)


# The function that writes each format, and the longest side that it can have.
_KINDS: dict[str, tuple[Callable[[Path, Frames, int], int], int]] = {
    ".mp4": (_write_mp4, 16384),
    ".gif": (_write_gif, 65535),
    ".webp": (_write_webp, 16383),
}
