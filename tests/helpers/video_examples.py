"""Shared by the tests of video: small real videos made with PyAV, their sound, and ways to damage them."""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from stereoweave.io.images import read_image

TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"
FRAME_MS = 40  # 25 frames a second
SOUND_RATE = 48_000

Pair = tuple[np.ndarray, np.ndarray]


def example_pairs(count: int, *, width: int = 160, height: int = 96, step_px: int = 2) -> list[Pair]:
    """Return windows of the example pair that move to the right, as seen by a camera moving sideways."""
    left, right = (read_image(TEXTURED / f"{eye}.png") for eye in ("left", "right"))
    top_px, first_px = 200, 180
    return [
        tuple(
            np.ascontiguousarray(picture[top_px : top_px + height, start : start + width])
            for picture in (left, right)
        )
        for start in range(first_px, first_px + count * step_px, step_px)
    ]


def flat_pairs(count: int, *, width: int = 64, height: int = 48) -> list[Pair]:
    """Return pairs of uniform colour, which distinguishes eyes and frames; the right eye is bluer."""
    return [
        tuple(np.full((height, width, 3), (20 + 8 * index, 100, blue), np.uint8) for blue in (60, 180))
        for index in range(count)
    ]


def packed(left: np.ndarray, right: np.ndarray, layout: str = "side_by_side") -> np.ndarray:
    """Pack both eyes into one image."""
    height_px, width_px = left.shape[:2]
    match layout:
        case "side_by_side":
            return np.hstack([left, right])
        case "crossed":
            return np.hstack([right, left])
        case "top_bottom":
            return np.vstack([left, right])
        case "top_bottom_right_first":
            return np.vstack([right, left])
        case "side_by_side_half":
            return np.hstack([shrunk(eye, width_px // 2, height_px) for eye in (left, right)])
        case "top_bottom_half":
            return np.vstack([shrunk(eye, width_px, height_px // 2) for eye in (left, right)])
        case "crossed_half" | "top_bottom_right_first_half":
            return packed(right, left, "side_by_side_half" if "crossed" in layout else "top_bottom_half")
        case "row_interleaved" | "column_interleaved" | "checkerboard":
            return interleaved(left, right, layout)
        case _ if layout.endswith("_right_first"):
            return packed(right, left, layout.removesuffix("_right_first"))
    raise ValueError(layout)


def interleaved(first: np.ndarray, second: np.ndarray, layout: str) -> np.ndarray:
    """Return an image whose rows, columns or fields of a checkerboard come from both in turn."""
    both = first.copy()
    if layout == "column_interleaved":
        both[:, 1::2] = second[:, 1::2]
    elif layout == "row_interleaved":
        both[1::2] = second[1::2]
    else:
        both[::2, 1::2] = second[::2, 1::2]
        both[1::2, ::2] = second[1::2, ::2]
    return both


def shrunk(image: np.ndarray, width_px: int, height_px: int) -> np.ndarray:
    return cv2.resize(image, (width_px, height_px), interpolation=cv2.INTER_AREA)


def write_side_by_side(
    path: Path,
    pairs: Iterable[Pair],
    *,
    times_ms: Sequence[int] | None = None,
    sound: bool = False,
    layout: str = "side_by_side",
    codec: str = "mpeg4",
    **more: object,
) -> Path:
    """Write a video of packed pairs; `more` is passed on to `write_video`."""
    frames = [packed(left, right, layout) for left, right in pairs]
    return write_video(path, frames, times_ms=times_ms, sound=sound, codec=codec, **more)


def write_video(
    path: Path,
    frames: Sequence[np.ndarray],
    *,
    times_ms: Sequence[int] | None = None,
    sound: bool = False,
    codec: str = "mpeg4",
    pix_fmt: str | None = None,
    colorspace: int = 2,
    color_range: int = 0,
    stereo_mode: str | None = None,
    rotation: int = 0,
    pixel_aspect: Fraction | None = None,
    options: dict[str, str] | None = None,
) -> Path:
    """Write a video of RGB frames, optionally with sound.

    Args:
        path: Output file; the extension determines the container.
        frames: uint8 RGB [H, W, 3], all of equal size.
        times_ms: Presentation times in ascending order; default: 25 frames a second.
        sound: Add a sine of 440 Hz in AAC, as long as the frames.
        codec: FFmpeg's name of an encoder: mpeg4, libx264, libx264rgb, ffv1, mjpeg, ...
        pix_fmt: Pixel format; default: the encoder's preferred one.
        colorspace: FFmpeg's AVCOL_SPC_*: 2 is unspecified, 1 BT.709, 5 and 6 BT.601.
        color_range: 0 unspecified, 1 limited, 2 full.
        stereo_mode: Matroska's frame packing tag, such as "left_right".
        rotation: Anticlockwise rotation in degrees that players must apply.
        pixel_aspect: Width of a pixel divided by its height.
        options: Encoder options, such as {"g": "12"} for a key frame every 12 frames.
    """
    times_ms = times_ms if times_ms is not None else [FRAME_MS * index for index in range(len(frames))]
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(1000, FRAME_MS))
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pix_fmt or _likes_best(codec)
        stream.codec_context.time_base = Fraction(1, 1000)
        stream.codec_context.colorspace = colorspace
        stream.codec_context.color_range = color_range
        stream.codec_context.options = {**_GOOD.get(codec, {}), **(options or {})}
        if stereo_mode:
            stream.metadata["stereo_mode"] = stereo_mode
        if pixel_aspect:
            stream.codec_context.sample_aspect_ratio = pixel_aspect
        if rotation:
            stream.set_display_rotation(rotation)
        track = container.add_stream("aac", rate=SOUND_RATE) if sound else None
        for image, time_ms in zip(frames, times_ms, strict=True):
            frame = av.VideoFrame.from_ndarray(image, "rgb24").reformat(
                format=stream.pix_fmt,
                dst_colorspace=colorspace if colorspace != 2 else None,
                dst_color_range=color_range or None,
                interpolation="BICUBIC",
            )
            frame.pts, frame.time_base = time_ms, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
        if track:
            _write_sine(container, track, (times_ms[-1] + FRAME_MS) / 1000)
    return path


def write_streams(
    path: Path,
    *streams: Sequence[np.ndarray],
    codec: str = "mjpeg",
    rates: Sequence[int] | None = None,
    sound: bool = False,
) -> Path:
    """Write a video with a stream for each list of frames, as Fujifilm's cameras do: one after the other."""
    with av.open(str(path), "w") as container:
        for index, frames in enumerate(streams):
            stream = container.add_stream(codec, rate=rates[index] if rates else 25)
            stream.height, stream.width = frames[0].shape[:2]
            stream.pix_fmt = {"mjpeg": "yuvj422p", "ffv1": "bgr0"}.get(codec, "yuv420p")
            stream.codec_context.qmax = 2
        track = container.add_stream("pcm_s16le", rate=8000) if sound else None
        for number in range(max(map(len, streams))):
            for index, (stream, frames) in enumerate(zip(container.streams.video, streams, strict=True)):
                if number < len(frames):
                    frame = av.VideoFrame.from_ndarray(frames[number], "rgb24")
                    frame.pts, frame.time_base = number, Fraction(1, rates[index] if rates else 25)
                    container.mux(stream.encode(frame))
        for stream in container.streams.video:
            container.mux(stream.encode())
        if track:
            wave = av.AudioFrame.from_ndarray(np.zeros((1, 8000), np.int16), format="s16", layout="mono")
            wave.pts, wave.rate, wave.time_base = 0, 8000, Fraction(1, 8000)
            container.mux([*track.encode(wave), *track.encode()])
    return path


def packets(path: Path, kind: str) -> list[tuple[int, bytes]]:
    """Return the time stamp and content of each packet of a kind, "video" or "audio"."""
    with av.open(str(path)) as container:
        return [
            (packet.pts, bytes(packet)) for packet in container.demux(**{kind: 0}) if packet.pts is not None
        ]


def damage(path: Path, *frames: int, length: int = 60) -> Path:
    """Overwrite bytes in the middle of the packets of some frames, numbered in file order."""
    content = bytearray(path.read_bytes())
    bodies = [body for _, body in packets(path, "video")]
    for frame in frames:
        start = content.find(bodies[frame])
        assert start >= 0
        start += min(len(bodies[frame]) // 3, 40)
        length = min(length, len(bodies[frame]) // 2)
        content[start : start + length] = np.random.default_rng(frame).bytes(length)
    path.write_bytes(content)
    return path


def truncate(path: Path, share: float) -> Path:
    """Truncate a file, like an interrupted download."""
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    return path


_GOOD = {"mpeg4": {"qmin": "2", "qmax": "2"}, "libx264": {"crf": "12"}, "libx264rgb": {"crf": "0"}}


def _likes_best(codec: str) -> str:
    return {"ffv1": "bgr0", "libx264rgb": "rgb24", "mjpeg": "yuvj420p"}.get(codec, "yuv420p")


def _write_sine(container: av.container.OutputContainer, track: av.AudioStream, length_s: float) -> None:
    samples = np.arange(int(length_s * SOUND_RATE))
    wave = (0.3 * np.sin(2 * np.pi * 440 / SOUND_RATE * samples)).astype(np.float32)
    for start in range(0, len(wave), 1024):
        frame = av.AudioFrame.from_ndarray(
            np.tile(wave[None, start : start + 1024], (2, 1)), format="fltp", layout="stereo"
        )
        frame.pts, frame.rate, frame.time_base = start, SOUND_RATE, Fraction(1, SOUND_RATE)
        container.mux(track.encode(frame))
    container.mux(track.encode())
