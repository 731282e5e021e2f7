"""What a pair shows as coloured points and as a surface in space, and the files that 3-D viewers open.

In arrays the axes are those of computer vision: the left camera at the origin, x right, y down, z forward, in
metres. In files they are those of the viewers: x right, y up, the camera looking along -z, in metres. glTF
prescribes it, and MeshLab, CloudCompare and Open3D open a PLY file upright that way.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8

from stereoweave.errors import Note, Remedy, StereoweaveError, require_extra
from stereoweave.io.files import replacing
from stereoweave.stereo import Estimate, StereoCamera, StereoPair, check_fits

NO_CAMERA = Note(
    "expected a camera, for metres, found none",
    Remedy(
        "give a calibration, or the focal length and baseline of a rectified pair",
        ("calibration", "focal_px", "baseline_m"),
    ),
)
MOST_POINTS = 4_000_000
# A surface that both cameras see changes by less than this from a pixel to the next: more is a jump.
_STEEPEST_PX = 1.0
# A pixel with something nearer and something farther this near, in its row or column, lies on neither.
_REACH_PX = 2
# With less shift than this the depth is anything from half of what is found to infinity.
_LEAST_SHIFT_PX = 1.0
_VIEWER_AXES = np.array([1, -1, -1], np.float32)


class EmptyError(StereoweaveError):
    """A pair without a point, or without a surface."""


@dataclass(frozen=True, kw_only=True)
class Cloud:
    """Coloured points.

    Attributes:
        points_m: float32 [N, 3]: x right, y down, z forward of the left camera, in metres.
        colours: uint8 RGB [N, 3], of the left photograph.
        step_px: Every how many pixels of rows and columns gave a point.
    """

    points_m: Float32[np.ndarray, "n 3"]
    colours: UInt8[np.ndarray, "n 3"]
    step_px: int = 1


@dataclass(frozen=True, kw_only=True)
class Surface(Cloud):
    """Points joined by triangles: faces int32 [M, 3] are their numbers, and face the camera."""

    faces: Int32[np.ndarray, "m 3"]


def point_cloud(
    pair: StereoPair, estimate: Estimate, *, least_confidence: float = 0.5, most_points: int = MOST_POINTS
) -> Cloud:
    """The points of the left photograph's pixels whose depth is known, as `solid` tells.

    Args:
        pair: The photographs, with their camera.
        estimate: Of this pair.
        least_confidence: Pixels of less confidence give no point.
        most_points: Of a picture with more only every second pixel of rows and columns counts, or third, ...

    Raises:
        StereoweaveError: The pair has no camera; EmptyError where no pixel is left.
    """
    camera = needed_camera(pair)
    known, step_px = _thinned(solid(pair, estimate, least_confidence), most_points)
    return _cloud(pair, estimate, camera, np.argwhere(known) * step_px, step_px)


def surface(
    pair: StereoPair, estimate: Estimate, *, least_confidence: float = 0.5, most_points: int = MOST_POINTS
) -> Surface:
    """The surface through the same points as `point_cloud`, open where the depth jumps; arguments as there.

    Neighbouring pixels are joined unless their disparities differ by more than 1 px a pixel. Points without a
    neighbour to be joined to are left out.
    """
    camera = needed_camera(pair)
    known, step_px = _thinned(solid(pair, estimate, least_confidence), most_points)
    faces = _faces(known, estimate.disparity_px[::step_px, ::step_px], _STEEPEST_PX * step_px)
    if not len(faces):
        raise EmptyError("expected neighbouring pixels of known depth on one surface, found none")
    used = np.zeros(np.count_nonzero(known), bool)
    used[faces] = True
    cloud = _cloud(pair, estimate, camera, np.argwhere(known)[used] * step_px, step_px)
    return Surface(
        points_m=cloud.points_m,
        colours=cloud.colours,
        step_px=step_px,
        faces=(np.cumsum(used, dtype=np.int32) - 1)[faces],
    )


def solid(pair: StereoPair, estimate: Estimate, least_confidence: float = 0.5) -> Bool[np.ndarray, "h w"]:
    """Which pixels of the left photograph have a depth that can be built upon.

    Not those that the left camera alone sees or nobody, nor those of less than `least_confidence`, of a shift
    under 1 px, which is next to infinity, or between two surfaces: a matcher blurs a depth edge, and the
    pixels of the blur would fly between the two. Such a pixel has both something nearer and something farther
    by more than 1 px within 2 px in its row, or in its column.
    """
    check_fits(estimate, pair)
    doffs_px = pair.camera.doffs_px if pair.camera else 0.0
    known = (estimate.confidence >= least_confidence) & ~estimate.occluded
    known &= estimate.disparity_px + doffs_px >= _LEAST_SHIFT_PX
    if pair.left_seen is not None:
        known &= pair.left_seen
    return known & ~_between_surfaces(estimate.disparity_px)


def needed_camera(pair: StereoPair) -> StereoCamera:
    """The camera of the pair; an error that says what to give where it has none."""
    if pair.camera is None:
        raise StereoweaveError(NO_CAMERA.text, remedy=NO_CAMERA.remedy)
    return pair.camera


def needing_the_mesh_extra() -> None:
    """An error that names the extra 'mesh' where what writes points and surfaces is missing."""
    _trimesh()


def write_ply(path: str | Path, cloud: Cloud) -> None:
    """Writes points or a surface as a binary PLY file, in the viewers' axes."""
    content = _shape(cloud).export(file_type="ply")
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_glb(path: str | Path, cloud: Cloud) -> None:
    """Writes points or a surface as a GLB file (binary glTF 2.0), to be shown as it is, without lamps."""
    linear = _linear(cloud.colours)

    def colour_exactly(buffers: Any, tree: dict[str, Any]) -> None:
        # glTF's colours are linear; trimesh writes them in 8 bits, too few for that where it is dark.
        accessor_at = tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]
        accessor = list(tree["accessors"].values())[accessor_at]
        buffers[list(buffers)[accessor["bufferView"]]] = linear.tobytes()
        accessor |= {"componentType": 5126, "type": "VEC3", "normalized": False}
        accessor["max"], accessor["min"] = linear.max(axis=0).tolist(), linear.min(axis=0).tolist()

    content = _shape(cloud).export(
        file_type="glb", buffer_postprocessor=colour_exactly, tree_postprocessor=_without_lamps
    )
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def _between_surfaces(disparity_px: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    values_px = np.asarray(disparity_px, np.float32)
    between = np.zeros(values_px.shape, bool)
    for shape in ((1, 2 * _REACH_PX + 1), (2 * _REACH_PX + 1, 1)):
        nearest_px, farthest_px = (extreme(values_px, np.ones(shape)) for extreme in (cv2.dilate, cv2.erode))
        between |= (nearest_px - values_px > _STEEPEST_PX) & (values_px - farthest_px > _STEEPEST_PX)
    return between


def _thinned(known: Bool[np.ndarray, "h w"], most_points: int) -> tuple[Bool[np.ndarray, "h2 w2"], int]:
    """Every step-th pixel of rows and columns, with the smallest step that leaves no more than allowed."""
    step_px = 1
    while np.count_nonzero(thinned := known[::step_px, ::step_px]) > most_points:
        step_px += 1
    if not thinned.any():
        raise EmptyError(
            "expected pixels of known depth, found none that is confident, seen by both cameras and nearer "
            "than infinity"
        )
    return thinned, step_px


def _cloud(
    pair: StereoPair,
    estimate: Estimate,
    camera: StereoCamera,
    places: Int[np.ndarray, "n 2"],
    step_px: int,
) -> Cloud:
    """The points of pixels, which are given by row and column."""
    rows, columns = places.T
    depth_m = camera.depth_m(estimate.disparity_px[rows, columns][None])[0]
    x, y = (columns - camera.cx_px) / camera.focal_px, (rows - camera.cy_px) / camera.focal_px
    points_m = np.stack([x * depth_m, y * depth_m, depth_m], axis=1).astype(np.float32)
    return Cloud(points_m=points_m, colours=pair.left[rows, columns], step_px=step_px)


def _faces(
    known: Bool[np.ndarray, "h w"], disparity_px: Float[np.ndarray, "h w"], most_px: float
) -> Int[np.ndarray, "m 3"]:
    """Two triangles a square of neighbours, of those that are known and that no more than most_px parts."""
    number = np.cumsum(known).reshape(known.shape) - 1
    here, right, below, across = np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1], np.s_[1:, 1:]
    faces = []
    # Counter-clockwise as the camera sees them: so their fronts are towards it.
    for corners in ((here, below, right), (right, below, across)):
        corners_px = np.stack([disparity_px[corner] for corner in corners])
        joined = np.all([known[corner] for corner in corners], axis=0) & (
            np.ptp(corners_px, axis=0) <= most_px
        )
        faces.append(np.stack([number[corner][joined] for corner in corners], axis=1))
    return np.concatenate(faces)


def _shape(cloud: Cloud) -> Any:
    """The same in trimesh's words and in the viewers' axes."""
    trimesh = _trimesh()
    points_m = cloud.points_m * _VIEWER_AXES
    if isinstance(cloud, Surface):
        return trimesh.Trimesh(points_m, cloud.faces, vertex_colors=cloud.colours, process=False)
    return trimesh.PointCloud(points_m, colors=cloud.colours)


def _trimesh() -> Any:
    with require_extra("mesh", "point clouds and meshes need trimesh"):
        import trimesh
    return trimesh


def _linear(colours: UInt8[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
    """Light in 0..1 of sRGB colours (IEC 61966-2-1)."""
    share = np.arange(256) / 255
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return light.astype(np.float32)[colours]


def _without_lamps(tree: dict[str, Any]) -> None:
    """Marks the one material as unlit: the photograph has its light already."""
    tree["materials"] = [
        {
            "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1},
            "extensions": {"KHR_materials_unlit": {}},
        }
    ]
    tree["meshes"][0]["primitives"][0]["material"] = 0
    tree["extensionsUsed"] = ["KHR_materials_unlit"]
