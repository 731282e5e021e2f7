"""What a frame of a VR180 or 360-degree video says about its projection.

FFmpeg reads it from `sv3d` (Google's Spherical Video V2 RFC), from `vexu` (Apple's "QuickTime and ISO Base
Media File Formats and Spatial and Immersive Media") and from Matroska's Projection.
"""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from stereoweave.cameras.spherical import (
    EQUIRECTANGULAR,
    FISHEYE,
    HALF,
    LEAST_LENS_DEG,
    MOST_LENS_DEG,
    Projection,
)
from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.video.spatial import RECTILINEAR_MAPPING, Stereo3D, parse_stereo3d, read_side_data

if TYPE_CHECKING:
    import av

# FFmpeg's AVSphericalProjection; cubemaps are 1, ordinary videos 4, parametric ones 6.
_TILE = 2
_NAMES = {0: EQUIRECTANGULAR, _TILE: EQUIRECTANGULAR, 3: HALF, 5: FISHEYE}
_KINDS = {1: "a cubemap", 6: "Apple's parametric projection of immersive video"}
# AVSphericalMapping: projection, yaw, pitch, roll, and the bounds in 0.32 bits: left, top, right, bottom.
_MAPPING_BYTES = 32


class SphereMark(NamedTuple):
    """What a file declares.

    Attributes:
        projection: Projection of each eye's image; None for an ordinary one.
        baseline_m: Distance of the eyes in metres; None if it is unknown.
    """

    projection: Projection | None
    baseline_m: float | None


def read_sphere(name: str, frame: "av.VideoFrame") -> SphereMark | None:
    """Return what a frame says about its projection; None if it says nothing.

    Raises:
        FormatError: The projection is not supported, or its bounds are impossible.
    """
    from av.sidedata.sidedata import Type

    side_data = read_side_data(frame)
    content = bytes(side_data.get(Type.SPHERICAL, b""))
    if len(content) < _MAPPING_BYTES:
        return None
    kind = int(np.frombuffer(content, np.int32, 1)[0])
    if kind == RECTILINEAR_MAPPING:
        return SphereMark(None, None)
    if kind not in _NAMES:
        raise FormatError(
            f"{name}: expected an equirectangular or fisheye video, found "
            f"{_KINDS.get(kind, 'an unknown projection')}; convert it to an equirectangular one first"
        )
    # The container's word on cameras comes first, and that of the stream, which knows of none, behind it.
    every = [side_data[index] for index in range(len(side_data))]
    cameras = [parse_stereo3d(data) for data in every if data.type == Type.STEREO3D]
    said = next((camera for camera in cameras if camera), Stereo3D())
    baseline_m = said.baseline_m or None
    if kind != _TILE:
        lens_deg = said.field_of_view_deg if _NAMES[kind] == FISHEYE else 0.0
        return SphereMark(_name_projection(name, _NAMES[kind], lens_deg or 180.0), baseline_m)
    left, top, right, bottom = (np.frombuffer(content, np.uint32, 4, 16) / 2**32).tolist()
    half_deg = 180 * (1 - left - right)
    try:
        part = Projection(
            name=HALF if half_deg <= 90 else EQUIRECTANGULAR,
            # Of a part, the middle is straight ahead: the rest is the heading of the camera.
            yaw_deg=(-half_deg, half_deg),
            pitch_deg=(-90 + 180 * bottom, 90 - 180 * top),
        )
    except StereoweaveError as error:
        raise FormatError(f"{name}: {error.message}; its bounds (sv3d) are damaged") from error
    return SphereMark(part, baseline_m)


def _name_projection(video: str, kind: str, lens_fov_deg: float) -> Projection:
    if not math.isfinite(lens_fov_deg) or not LEAST_LENS_DEG <= lens_fov_deg <= MOST_LENS_DEG:
        raise FormatError(
            f"{video}: expected a fisheye of {LEAST_LENS_DEG:g} to {MOST_LENS_DEG:g} degrees, found "
            f"{lens_fov_deg:g}; its marks are damaged"
        )
    return Projection.named(kind, lens_fov_deg)
