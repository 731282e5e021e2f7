"""Videos and spatial photos that are marked as 3-D: their boxes are read and changed."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from pillow_heif import HeifFile

from fuzz.targets import Target, write_to_bytes
from fuzz.targets.pictures import eyes
from stereoweave.io.spatial_photos import mark_views
from stereoweave.stereo import StereoCamera
from stereoweave.video.mp4_marks import VideoMarks, write_marks

_SPATIAL = Path(__file__).resolve().parents[2] / "tests" / "spatial_video" / "pan.mp4"
_MARKS = VideoMarks(packing="side_by_side", projection="half_equirectangular", baseline_m=0.065)
_CAMERA = StereoCamera(focal_px=100.0, baseline_m=0.06, cx_px=48.0, cy_px=32.0)


def _starts() -> dict[str, bytes]:
    return {
        "packed.mp4": write_to_bytes("packed.mp4", _write_video),
        _SPATIAL.name: _SPATIAL.read_bytes(),
        "pair.heic": write_to_bytes("pair.heic", _write_photo),
    }


def _write_video(path: Path) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        assert isinstance(stream, av.VideoStream)
        image = np.hstack(eyes(0))
        stream.height, stream.width, stream.pix_fmt = *image.shape[:2], "yuv420p"
        frame = av.VideoFrame.from_ndarray(image, "rgb24")
        frame.pts, frame.time_base = 0, Fraction(1, 25)
        container.mux(stream.encode(frame))
        container.mux(stream.encode())


def _write_photo(path: Path) -> None:
    file = HeifFile()
    for image in eyes(0):
        file.add_frombytes("RGB", (image.shape[1], image.shape[0]), np.ascontiguousarray(image).tobytes())
    file.save(path)


def _read(path: Path) -> None:
    if path.suffix == ".heic":
        mark_views(path.read_bytes(), _CAMERA, (96, 64))
    else:
        write_marks(path, _MARKS)


TARGET = Target(
    starts=_starts,
    read=_read,
    tokens=tuple(
        b"moov trak mdia minf stbl stsd hdlr vide moof mdat free st3d sv3d vexu hfov avc1 hvc1 "
        b"meta iinf infe iloc iprp ipco ipma grpl ster pitm".split()
    ),
)
