"""Coloured point clouds and meshes of a pair, and their PLY and GLB files.

Arrays use the axes of computer vision, in metres: origin at the left camera, x right, y down and z forward.
Files use the axes of 3-D viewers, in metres: x right, y up, with the camera looking along -z. glTF prescribes
these axes; with them, MeshLab, CloudCompare and Open3D show PLY files upright.
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
    "expected a camera for depth, found none",
    Remedy(
        "give a calibration, or the focal length and baseline of a rectified pair",
        ("calibration", "focal_px", "baseline_m"),
    ),
)
MOST_POINTS = 4_000_000
# Largest disparity difference between neighbouring pixels of a surface that both cameras see; a larger
# difference is a depth edge.
_STEEPEST_PX = 1.0
# Half the size of the window in which a mixed pixel has both a nearer and a farther neighbour.
_REACH_PX = 2
# Below this disparity + doffs, the true depth may be anything from half the estimate to infinity.
_LEAST_SHIFT_PX = 1.0
_VIEWER_AXES = np.array([1, -1, -1], np.float32)


class EmptyError(StereoweaveError):
    """Error for a pair that yields no points or no triangles."""


@dataclass(frozen=True, kw_only=True)
class PointCloud:
    """Coloured point cloud.

    Attributes:
        points_m: float32 [N, 3] in metres, in the left camera's axes: x right, y down and z forward.
        colours: uint8 RGB [N, 3], from the left image.
        step_px: Sampling step along rows and columns.
    """

    points_m: Float32[np.ndarray, "n 3"]
    colours: UInt8[np.ndarray, "n 3"]
    step_px: int = 1


@dataclass(frozen=True, kw_only=True)
class Mesh(PointCloud):
    """Triangle mesh; `faces`, int32 [M, 3], holds vertex indices, with front sides facing the camera."""

    faces: Int32[np.ndarray, "m 3"]


def make_point_cloud(
    pair: StereoPair, estimate: Estimate, *, least_confidence: float = 0.5, most_points: int = MOST_POINTS
) -> PointCloud:
    """Return the point cloud of the left image's pixels with reliable depth (`find_reliable`).

    Args:
        pair: The pair, with its camera.
        estimate: The pair's estimate.
        least_confidence: Lowest confidence of a pixel to use.
        most_points: Maximum number of points. If there are more, only every nth row and every nth column
            are used.

    Raises:
        StereoweaveError: The pair has no camera.
        EmptyError: No pixel has a reliable depth.
    """
    camera = require_camera(pair)
    known, step_px = _thin(find_reliable(pair, estimate, least_confidence), most_points)
    return _place_points(pair, estimate, camera, np.argwhere(known) * step_px, step_px)


def make_mesh(
    pair: StereoPair, estimate: Estimate, *, least_confidence: float = 0.5, most_points: int = MOST_POINTS
) -> Mesh:
    """Return the mesh through the points of `make_point_cloud`, with gaps at depth edges.

    The arguments and errors are those of `make_point_cloud`. Neighbouring pixels are joined unless their
    disparities differ by more than 1 px per pixel. Points that no triangle uses are removed.
    """
    camera = require_camera(pair)
    known, step_px = _thin(find_reliable(pair, estimate, least_confidence), most_points)
    faces = _triangulate(known, estimate.disparity_px[::step_px, ::step_px], _STEEPEST_PX * step_px)
    if not len(faces):
        raise EmptyError("expected neighbouring pixels of known depth on the same surface, found none")
    used = np.zeros(np.count_nonzero(known), bool)
    used[faces] = True
    cloud = _place_points(pair, estimate, camera, np.argwhere(known)[used] * step_px, step_px)
    return Mesh(
        points_m=cloud.points_m,
        colours=cloud.colours,
        step_px=step_px,
        faces=(np.cumsum(used, dtype=np.int32) - 1)[faces],
    )


def find_reliable(
    pair: StereoPair, estimate: Estimate, least_confidence: float = 0.5
) -> Bool[np.ndarray, "h w"]:
    """Return the mask of the left image's pixels with reliable depth.

    It excludes occluded pixels, pixels outside the image's content, pixels with a confidence below
    `least_confidence`, pixels with disparity + doffs below 1 px (nearly infinite depth), and mixed pixels.
    Matchers blur depth edges, so the points of mixed pixels would float between two surfaces. A mixed pixel
    has, within 2 px along its row or its column, one neighbour that is nearer by more than 1 px of disparity
    and one that is farther by more than 1 px.
    """
    check_fits(estimate, pair)
    doffs_px = pair.camera.doffs_px if pair.camera else 0.0
    known = (estimate.confidence >= least_confidence) & ~estimate.occluded
    known &= estimate.disparity_px + doffs_px >= _LEAST_SHIFT_PX
    if pair.left_seen is not None:
        known &= pair.left_seen
    return known & ~_find_mixed_pixels(estimate.disparity_px)


def require_camera(pair: StereoPair) -> StereoCamera:
    """Return the pair's camera; raise a StereoweaveError with a remedy if the pair has none."""
    if pair.camera is None:
        raise StereoweaveError(NO_CAMERA.text, remedy=NO_CAMERA.remedy)
    return pair.camera


def require_mesh_extra() -> None:
    """Raise an error that names the extra 'mesh' if trimesh is not installed."""
    _import_trimesh()


def write_ply(path: str | Path, cloud: PointCloud) -> None:
    """Write a point cloud or mesh as a binary PLY file, in the axes of 3-D viewers."""
    content = _convert_to_trimesh(cloud).export(file_type="ply")
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_glb(path: str | Path, cloud: PointCloud) -> None:
    """Write a point cloud or mesh as a GLB file (binary glTF 2.0) with an unlit material."""
    linear = _linearize(cloud.colours)

    def colour_exactly(buffers: Any, tree: dict[str, Any]) -> None:
        # glTF colours are linear; trimesh writes them with 8 bits, which are too few for dark colours.
        accessor_at = tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]
        accessor = list(tree["accessors"].values())[accessor_at]
        buffers[list(buffers)[accessor["bufferView"]]] = linear.tobytes()
        accessor |= {"componentType": 5126, "type": "VEC3", "normalized": False}
        accessor["max"], accessor["min"] = linear.max(axis=0).tolist(), linear.min(axis=0).tolist()

    content = _convert_to_trimesh(cloud).export(
        file_type="glb", buffer_postprocessor=colour_exactly, tree_postprocessor=_mark_unlit
    )
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def _find_mixed_pixels(disparity_px: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    values_px = np.asarray(disparity_px, np.float32)
    between = np.zeros(values_px.shape, bool)
    for shape in ((1, 2 * _REACH_PX + 1), (2 * _REACH_PX + 1, 1)):
        nearest_px, farthest_px = (extreme(values_px, np.ones(shape)) for extreme in (cv2.dilate, cv2.erode))
        between |= (nearest_px - values_px > _STEEPEST_PX) & (values_px - farthest_px > _STEEPEST_PX)
    return between


def _thin(known: Bool[np.ndarray, "h w"], most_points: int) -> tuple[Bool[np.ndarray, "h2 w2"], int]:
    """Subsample rows and columns with the smallest step that leaves at most `most_points` pixels."""
    if most_points < 1:
        raise StereoweaveError(f"most_points: expected at least 1, found {most_points}")
    step_px = 1
    while np.count_nonzero(thinned := known[::step_px, ::step_px]) > most_points:
        step_px += 1
    if not thinned.any():
        raise EmptyError(
            "expected pixels of known depth, found none that are confident, are seen by both cameras and are "
            "not infinitely far"
        )
    return thinned, step_px


def _place_points(
    pair: StereoPair,
    estimate: Estimate,
    camera: StereoCamera,
    places: Int[np.ndarray, "n 2"],
    step_px: int,
) -> PointCloud:
    """Return the point cloud of the pixels at the given rows and columns."""
    rows, columns = places.T
    depth_m = camera.depth_m(estimate.disparity_px[rows, columns][None])[0]
    x, y = (columns - camera.cx_px) / camera.focal_px, (rows - camera.cy_px) / camera.focal_px
    points_m = np.stack([x * depth_m, y * depth_m, depth_m], axis=1).astype(np.float32)
    return PointCloud(points_m=points_m, colours=pair.left[rows, columns], step_px=step_px)


def _triangulate(
    known: Bool[np.ndarray, "h w"], disparity_px: Float[np.ndarray, "h w"], most_px: float
) -> Int[np.ndarray, "m 3"]:
    """Return up to two triangles per square of pixels.

    In each triangle, all three corners have known depth, and their disparities differ by at most `most_px`.
    """
    number = np.cumsum(known).reshape(known.shape) - 1
    here, right, below, across = np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1], np.s_[1:, 1:]
    faces = []
    # Counter-clockwise as seen from the camera, so that the front sides face it.
    for corners in ((here, below, right), (right, below, across)):
        corners_px = np.stack([disparity_px[corner] for corner in corners])
        joined = np.all([known[corner] for corner in corners], axis=0) & (
            np.ptp(corners_px, axis=0) <= most_px
        )
        faces.append(np.stack([number[corner][joined] for corner in corners], axis=1))
    return np.concatenate(faces)


def _convert_to_trimesh(cloud: PointCloud) -> Any:
    """Convert a point cloud or mesh to a trimesh object, in the axes of 3-D viewers."""
    trimesh = _import_trimesh()
    points_m = cloud.points_m * _VIEWER_AXES
    if isinstance(cloud, Mesh):
        return trimesh.Trimesh(points_m, cloud.faces, vertex_colors=cloud.colours, process=False)
    return trimesh.PointCloud(points_m, colors=cloud.colours)


def _import_trimesh() -> Any:
    with require_extra("mesh", "point clouds and meshes need trimesh"):
        import trimesh
    return trimesh


def _linearize(colours: UInt8[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
    """Convert sRGB colours to linear light in 0..1 (IEC 61966-2-1)."""
    share = np.arange(256) / 255
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return light.astype(np.float32)[colours]


def _mark_unlit(tree: dict[str, Any]) -> None:
    """Mark the only material as unlit, because the colours already contain the scene's lighting."""
    tree["materials"] = [
        {
            "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1},
            "extensions": {"KHR_materials_unlit": {}},
        }
    ]
    tree["meshes"][0]["primitives"][0]["material"] = 0
    tree["extensionsUsed"] = ["KHR_materials_unlit"]
