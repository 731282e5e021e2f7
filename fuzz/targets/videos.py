"""Stereo videos in several containers and codecs, and a spatial one."""

from fractions import Fraction
from functools import partial
from itertools import islice
from pathlib import Path

import av
import numpy as np

from fuzz.targets import Target, read_every_way, write_to_bytes
from fuzz.targets.pictures import eyes
from stereoweave.video.reader import open_video
from stereoweave.video.tracks import open_track, shows_one_view

_FRAMES = 5
_KINDS = {
    "mpeg4_SBS.mp4": "mpeg4",
    "h264_SBS.mp4": "libx264",
    "ffv1_SBS.mkv": "ffv1",
    "mjpeg_SBS.avi": "mjpeg",
}
_SPATIAL = Path(__file__).resolve().parents[2] / "tests" / "spatial_video" / "pan.mp4"
_PIXELS = {"ffv1": "bgr0", "mjpeg": "yuvj420p"}


def _starts() -> dict[str, bytes]:
    written = {name: write_to_bytes(name, partial(_write, codec=codec)) for name, codec in _KINDS.items()}
    twins = {"streams.avi": write_to_bytes("streams.avi", _write_twins)}
    return written | twins | {_SPATIAL.name: _SPATIAL.read_bytes()}


def _write_twins(path: Path) -> None:
    """Write a video with a stream for each view."""
    with av.open(str(path), "w") as container:
        streams = [container.add_stream("mjpeg", rate=25) for _ in range(2)]
        for stream in streams:
            assert isinstance(stream, av.VideoStream)
            stream.height, stream.width, stream.pix_fmt = *eyes()[0].shape[:2], "yuvj420p"
        for index, images in enumerate(map(eyes, range(_FRAMES))):
            for stream, image in zip(streams, images, strict=True):
                assert isinstance(stream, av.VideoStream)
                frame = av.VideoFrame.from_ndarray(image, "rgb24")
                frame.pts, frame.time_base = index, Fraction(1, 25)
                container.mux(stream.encode(frame))
        for stream in streams:
            container.mux(stream.encode())


def _write(path: Path, codec: str) -> None:
    frames = [np.hstack(eyes(seed)) for seed in range(_FRAMES)]
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25)
        assert isinstance(stream, av.VideoStream)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = _PIXELS.get(codec, "yuv420p")
        for index, image in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(image, "rgb24")
            frame.pts, frame.time_base = index, Fraction(1, 25)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def _read(path: Path) -> None:
    # Detection would take most of the time; the target for pictures covers it.
    format = None if shows_one_view(path, spatial_only=True) else "side_by_side"
    read_every_way(
        *(partial(_read_frames, path, each) for each in (format, "two_streams", "frame_sequential"))
    )
    open_track(path, None).samples()


def _read_frames(path: Path, format: str | None) -> None:
    for _ in islice(open_video([path], format).frames(), 2 * _FRAMES):
        pass


TARGET = Target(
    starts=_starts,
    read=_read,
    tokens=(
        *b"moov mdat trak stts stsz stco ctts elst st3d sv3d avcC RIFF movi idx1 00dc LIST strf".split(),
        *b"hvcC lhvC vexu eyes stri blin dadj hfov".split(),
        *(b"\0\0\1", b"\x1a\x45\xdf\xa3", b"\xa3", b"\x53\xb8", b"\xe7"),
    ),
)
