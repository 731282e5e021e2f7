"""Geometric primitives: tubes, boxes, solids of revolution, lofts, sheets and spheres.

Tubes, boxes and spheres are vectorised over arrays of pieces, because a mast can have a thousand struts.
Lengths are in metres, and z is up. Points and sizes are [N, 3], or [3] if they are the same for all pieces.
Texture coordinates are in metres along the surface.
"""

import functools
import math
from collections.abc import Sequence
from itertools import product
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int

from stereoweave.synth.world import Mesh, join_meshes

Point = Float[np.ndarray, "3"]
Points = Float[np.ndarray, "_ 3"]
Numbers = np.ndarray | Sequence[Any] | float  # an array, or nested sequences

# Two triangles per side, counter-clockwise when seen from outside. Corner 4 x + 2 y + z has the coordinates
# x, y and z, each 0 or 1.
_CUBE_FACES = (
    *((1, 3, 0), (4, 1, 0), (0, 3, 2), (2, 4, 0), (1, 7, 3), (5, 1, 4)),
    *((5, 7, 1), (3, 7, 2), (6, 4, 2), (2, 7, 6), (6, 5, 4), (7, 5, 6)),
)
# Indices into the corners of three golden rectangles, taken in order.
_ICOSAHEDRON_FACES = (
    *((0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2)),
    *((10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5)),
    *((2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)),
)


def tubes(  # noqa: PLR0913 - dimensions and options
    starts_m: Numbers,
    ends_m: Numbers,
    radii_m: Numbers,
    material: int,
    sides: int = 6,
    capped: bool = True,
) -> Mesh:
    """Build straight round bars [N] from start to end; if `capped`, flat caps close both ends.

    radii_m: one radius for all bars, one radius per bar [N], or the radii at both ends of each bar [N, 2].
    """
    starts, ends = np.broadcast_arrays(np.atleast_2d(starts_m), np.atleast_2d(ends_m))
    count = len(starts)
    radii = np.asarray(radii_m, np.float64)
    radii = np.broadcast_to(radii[:, None] if radii.ndim == 1 else radii, (count, 2))
    along = ends - starts
    length = np.linalg.norm(along, axis=1)
    along = along / length[:, None]
    across, other = orthogonal_frames(along)
    plan = _tube_topology(sides, capped)
    outwards = plan.circle @ np.stack([across, other], 1)
    middles = np.stack([starts, ends], 1)
    rings = middles[:, :, None] + radii[..., None, None] * outwards[:, None]
    around = np.arctan2(plan.circle[:, 1], plan.circle[:, 0]) % (2 * np.pi) * radii.max(1)[:, None]
    around[:, -1] = 2 * np.pi * radii.max(1)
    # Each piece shows a different part of the texture.
    offset = np.broadcast_to((np.arange(count) * 0.618)[:, None] % 7, around.shape)
    sides_uv = [np.stack([around, offset + up], -1) for up in (0, length[:, None])]
    ends_uv = radii[..., None, None] * plan.circle
    points = np.concatenate([rings.reshape(count, 2 * len(plan.circle), 3), middles], 1)
    normals = np.concatenate([outwards, -along[:, None], along[:, None]], 1)
    uv = np.concatenate(
        [*sides_uv, ends_uv.reshape(count, 2 * len(plan.circle), 2), np.zeros((count, 2, 2))], 1
    )
    corners = points.astype(np.float32)[:, plan.points]
    mesh = _make_mesh(
        corners, normals.astype(np.float32)[:, plan.normals], uv.astype(np.float32)[:, plan.uv], material
    )
    return mesh if radii.all() else _drop_degenerate(mesh)


def boxes(
    centres_m: Numbers, sizes_m: Numbers, material: int, turns: Float[np.ndarray, "_ 3 3"] | None = None
) -> Mesh:
    """Build boxes [N]; `turns` rotates each box about its centre."""
    centres, sizes = np.broadcast_arrays(np.atleast_2d(centres_m), np.atleast_2d(sizes_m))
    cube, face_normals = _cube()
    corners = cube[None] * (sizes / 2)[:, None, None]
    normals = np.broadcast_to(face_normals, corners.shape)
    uv = _box_uv(corners, normals) + (np.arange(len(corners)) * 0.618 % 7)[:, None, None, None]
    if turns is not None:
        across = turns.swapaxes(1, 2)[:, None]
        corners, normals = corners @ across, normals @ across
    return _make_mesh(corners + centres[:, None, None], normals, uv, material)


def lathe(profile_m: Numbers, material: int, sections: int = 32, crease_deg: float = 35) -> Mesh:
    """Build a solid of revolution around z.

    Edges where the direction of the profile changes by more than `crease_deg` stay sharp.

    profile_m: [K, 2], radius and height of points along the outside from bottom to top.
    """
    profile = np.asarray(profile_m, np.float64)
    angle = np.arange(sections + 1) * 2 * np.pi / sections
    circle = np.stack([np.cos(angle), np.sin(angle)], -1)
    step = np.diff(profile, axis=0)
    slope = step / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)
    flat = np.stack([slope[:, 1], -slope[:, 0]], -1)  # outwards, because the profile rises along the outside
    below, above = flat.copy(), flat.copy()
    smooth = (flat[:-1] * flat[1:]).sum(1) > np.cos(np.radians(crease_deg))
    mean = flat[:-1] + flat[1:]
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    below[1:][smooth], above[:-1][smooth] = mean[smooth], mean[smooth]
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(step, axis=1))])
    spans = np.stack([profile[:-1], profile[1:]], 1)
    girth = spans[:, :, 0].max(1)[:, None, None] * angle
    height = np.stack([arc[:-1], arc[1:]], 1)[..., None]
    uv = np.stack(np.broadcast_arrays(girth, height), -1)
    return _mesh_grids(_revolve(circle, spans), _revolve(circle, np.stack([below, above], 1)), uv, material)


def loft(rings_m: Float[np.ndarray, "k m 3"], material: int, capped: bool = True) -> Mesh:
    """Build a smooth closed surface through rings of points, such as a hull, a blade or a bent pipe.

    Rings run counter-clockwise as seen from the last ring towards the first, and do not repeat their first
    point. If `capped`, triangle fans close the first and the last ring.
    """
    rings = np.asarray(rings_m, np.float64)
    rings = np.concatenate([rings, rings[:, :1]], axis=1)
    skin = sheet(rings, material, closed=True)
    if not capped:
        return skin
    return _add_caps(skin, rings[[0, -1]][None], material)


def sweep(path_m: Numbers, radius_m: Numbers, material: int, sides: int = 8) -> Mesh:
    """Build a round pipe or cable along a path [K, 3].

    radius_m: one radius for the whole path, or one radius per point.
    """
    path = np.asarray(path_m, np.float64)
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across, other = _transport_frames(along)
    angle = np.arange(sides) * 2 * np.pi / sides
    outwards = np.cos(angle)[None, :, None] * across[:, None] + np.sin(angle)[None, :, None] * other[:, None]
    radii = np.broadcast_to(np.asarray(radius_m, np.float64), len(path))
    return loft(path[:, None] + radii[:, None, None] * outwards, material)


def sheet(points_m: Float[np.ndarray, "r c 3"], material: int, closed: bool = False) -> Mesh:
    """Build a smooth surface through a grid of points.

    A sheet faces up if x increases with the column index and y with the row index. Set `closed` if the last
    column repeats the first.
    """
    points = np.asarray(points_m, np.float64)
    if closed:
        wrapped = np.concatenate([points[:, -2:-1], points, points[:, 1:2]], axis=1)
        along_columns = (wrapped[:, 2:] - wrapped[:, :-2]) / 2
    else:
        along_columns = np.gradient(points, axis=1)
    normals = np.cross(along_columns, np.gradient(points, axis=0))
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    u = _arc_lengths_m(points, 1).mean(0)[None] * np.ones((len(points), 1))
    v = _arc_lengths_m(points, 0).mean(1)[:, None] * np.ones((1, points.shape[1]))
    return _mesh_grids(points[None], normals[None], np.stack([u, v], -1)[None], material)


def spheres(centres_m: Numbers, radii_m: Numbers, material: int, subdivisions: int = 2) -> Mesh:
    """Build spheres [N].

    radii_m: one radius for all spheres, one radius per sphere [N], or the semi-axes of ellipsoids
        along x, y and z [N, 3].
    """
    centres = np.atleast_2d(np.asarray(centres_m, np.float64))
    radii = np.asarray(radii_m, np.float64)
    radii = np.broadcast_to(radii[:, None] if radii.ndim == 1 else radii, (len(centres), 3))
    ball = _ball(subdivisions)
    corners = ball[None] * radii[:, None, None]
    normals = ball[None] / radii[:, None, None]
    normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    uv = _box_uv(
        corners, np.broadcast_to(ball.mean(1, keepdims=True), ball.shape)[None].repeat(len(radii), 0)
    )
    return _make_mesh(corners + centres[:, None, None], normals, uv, material)


def facets(triangles_m: Numbers, material: int) -> Mesh:
    """Build flat triangles [N, 3, 3], counter-clockwise when seen from outside."""
    triangles = np.asarray(triangles_m, np.float64)
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    normals = np.repeat(across[:, None], 3, axis=1)
    return _make_mesh(triangles, normals, _box_uv(triangles, normals), material)


def prism(outline_m: Numbers, depth_m: float, material: int) -> Mesh:
    """Extrude a convex outline from z = 0 to z = depth_m.

    outline_m: [K, 2], counter-clockwise when seen from above.
    """
    floor = np.pad(np.asarray(outline_m, np.float64), ((0, 0), (0, 1)))
    roof = floor + [0, 0, depth_m]
    after, above = np.roll(floor, -1, axis=0), np.roll(roof, -1, axis=0)
    walls = [np.stack([floor, after, above], 1), np.stack([floor, above, roof], 1)]
    fan = [
        np.stack([np.broadcast_to(ring[0], (len(ring) - 2, 3)), ring[1:-1], ring[2:]], 1)
        for ring in (roof, floor[::-1])
    ]
    return facets(np.concatenate(walls + fan), material)


def copies(mesh: Mesh, poses: Float[np.ndarray, "n 4 4"]) -> Mesh:
    """Return a mesh that contains one copy of `mesh` per pose [N, 4, 4]; poses may scale uniformly."""
    turns = poses[:, :3, :3].swapaxes(1, 2)
    scales = np.cbrt(np.abs(np.linalg.det(turns)))[:, None, None]
    corners = mesh.corners_m.reshape(-1, 3) @ turns.astype(np.float32)
    corners += poses[:, None, :3, 3].astype(np.float32)
    normals = mesh.normals.reshape(-1, 3) @ (turns / scales).astype(np.float32)
    uv = mesh.uv_m + (np.arange(len(poses), dtype=np.float32) * 0.618 % 7)[:, None, None, None]
    count = len(poses)
    return Mesh(
        corners_m=corners.reshape(-1, 3, 3),
        normals=normals.reshape(-1, 3, 3),
        uv_m=uv.reshape(-1, 3, 2),
        material=np.tile(mesh.material, count),
        target=np.tile(mesh.target, count),
    )


def rotation(axis: tuple[float, float, float], angle_deg: float) -> Float[np.ndarray, "4 4"]:
    """Return the pose [4, 4] of a rotation about an axis through the origin.

    The rotation is counter-clockwise when seen from the tip of the axis.
    """
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.radians(angle_deg) * np.array(axis) / np.linalg.norm(axis))[0]
    return pose


def translation(x: float = 0, y: float = 0, z: float = 0) -> Float[np.ndarray, "4 4"]:
    """Return the pose [4, 4] of a translation in metres."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def orthogonal_frames(along: Points) -> tuple[Points, Points]:
    """Return two arrays of unit vectors [N, 3] that form right-handed frames with the unit directions [N, 3].

    Vectors in the first array are horizontal or, for directions within 2.5 degrees of vertical, nearly
    parallel to y.
    """
    helper = np.where(np.abs(along[:, 2:]) < 0.999, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    across = np.cross(helper, along)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return across, np.cross(along, across)


def polyline_tubes(points_m: Numbers, radius_m: float, material: int, sides: int = 6) -> Mesh:
    """Build tubes along a polyline, such as a frame or a sagging wire."""
    points = np.asarray(points_m)
    return tubes(points[:-1], points[1:], radius_m, material, sides)


def _mesh_grids(
    points: Float[np.ndarray, "n r c 3"],
    normals: Float[np.ndarray, "n r c 3"],
    uv: Float[np.ndarray, "n r c 2"],
    material: int,
) -> Mesh:
    """Return a mesh with two triangles per cell of each grid."""

    def cells(values: np.ndarray) -> np.ndarray:
        a, b, c, d = values[:, :-1, :-1], values[:, :-1, 1:], values[:, 1:, 1:], values[:, 1:, :-1]
        return np.stack([np.stack([a, b, c], -2), np.stack([a, c, d], -2)], -3)

    corners, corner_normals, corner_uv = (
        cells(values.astype(np.float32)) for values in (points, normals, uv)
    )
    return _drop_degenerate(_make_mesh(corners, corner_normals, corner_uv, material))


def _drop_degenerate(mesh: Mesh) -> Mesh:
    """Remove triangles of zero area, such as those in grid cells at a pole."""
    a, b, c = mesh.corners_m.swapaxes(0, 1)
    kept = (np.abs(np.cross(b - a, c - a)) > 1e-12).any(1)
    if kept.all():
        return mesh
    return Mesh(
        corners_m=mesh.corners_m[kept],
        normals=mesh.normals[kept],
        uv_m=mesh.uv_m[kept],
        material=mesh.material[kept],
        target=mesh.target[kept],
    )


def _add_caps(walls: Mesh, ends: Float[np.ndarray, "n 2 m 3"], material: int) -> Mesh:
    """Close the first and the last ring with triangle fans; a ring's last point repeats its first point."""
    fans = [walls]
    for k in (0, 1):
        ring = ends[:, k] if k else ends[:, k, ::-1]
        middle = ring[:, :-1].mean(1)[:, None]
        corners = np.stack([np.broadcast_to(middle, ring[:, 1:].shape), ring[:, :-1], ring[:, 1:]], -2)
        normal = np.cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :])
        solid = np.linalg.norm(normal, axis=-1) > 1e-12
        summed = normal.sum(1, keepdims=True)
        summed = summed / np.maximum(np.linalg.norm(summed, axis=-1, keepdims=True), 1e-12)
        normals = np.broadcast_to(summed[:, :, None], corners.shape)
        uv = _box_uv(corners, normals)
        fans.append(_make_mesh(corners[solid], normals[solid], uv[solid], material))
    return join_meshes(fans)


def _make_mesh(corners: np.ndarray, normals: np.ndarray, uv: np.ndarray, material: int) -> Mesh:
    count = corners.size // 9
    return Mesh(
        corners_m=corners.reshape(-1, 3, 3).astype(np.float32, copy=False),
        normals=normals.reshape(-1, 3, 3).astype(np.float32, copy=False),
        uv_m=uv.reshape(-1, 3, 2).astype(np.float32, copy=False),
        material=np.full(count, material, np.int32),
        target=np.zeros(count, bool),
    )


def _transport_frames(along: Points) -> tuple[Points, Points]:
    """Return two arrays of unit vectors [N, 3] that are perpendicular to a path at its points.

    Both vectors are parallel-transported along the path, so pipes do not twist.
    """
    across = orthogonal_frames(along[:1])[0][0]
    carried = []
    # Plain floats are faster than arrays of three elements.
    u, v, w = across.tolist()
    for x, y, z in along.tolist():
        off = u * x + v * y + w * z
        u, v, w = u - off * x, v - off * y, w - off * z
        size = math.sqrt(u * u + v * v + w * w)
        u, v, w = u / size, v / size, w / size
        carried.append((u, v, w))
    stacked = np.array(carried)
    return stacked, np.cross(along, stacked)


def _revolve(circle: Float[np.ndarray, "s 2"], radius_and_height: np.ndarray) -> np.ndarray:
    """Return rings [..., S, 3] with the given radii and heights [..., 2]."""
    radius, height = radius_and_height[..., None, :1], radius_and_height[..., None, 1:]
    level = radius * circle
    return np.concatenate([level, np.broadcast_to(height, (*level.shape[:-1], 1))], -1)


def _arc_lengths_m(points: Float[np.ndarray, "r c 3"], axis: int) -> Float[np.ndarray, "r c"]:
    """Return the arc length from the first point along one axis of the grid."""
    step = np.linalg.norm(np.diff(points, axis=axis), axis=-1)
    start = np.zeros_like(np.take(step, [0], axis=axis))
    return np.concatenate([start, np.cumsum(step, axis=axis)], axis=axis)


def _box_uv(corners: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return texture coordinates from a box projection.

    These are the coordinates along the two axes other than the dominant axis of the normal.
    """
    axis = np.abs(normals[..., :1, :]).argmax(-1)[..., None]
    x, y, z = corners[..., 0], corners[..., 1], corners[..., 2]
    axis = axis[..., 0] * np.ones(x.shape, int)
    u = np.where(axis == 0, y, x)
    v = np.where(axis == 2, y, z)
    return np.stack([u, v], -1)


class _TubeTopology(NamedTuple):
    """Topology of a tube with S sides and T triangles.

    Attributes:
        circle: [S + 1, 2], unit circle; the last point repeats the first.
        points: [T, 3], indices into the points: the ring at the start, the ring at the end and both centres.
        normals: [T, 3], indices into the normals: those of a ring, then those of the start and end caps.
        uv: [T, 3], indices into the texture coordinates: both rings for the sides, then all points for the
            ends.
    """

    circle: Float[np.ndarray, "s 2"]
    points: Int[np.ndarray, "t 3"]
    normals: Int[np.ndarray, "t 3"]
    uv: Int[np.ndarray, "t 3"]


@functools.cache
def _tube_topology(sides: int, capped: bool) -> _TubeTopology:
    angle = np.arange(sides + 1) * 2 * np.pi / sides
    k, ring = np.arange(sides), sides + 1
    walls = np.concatenate([np.stack([k, k + 1, k + 1 + ring], 1), np.stack([k, k + 1 + ring, k + ring], 1)])
    back = np.stack([np.full(sides, 2 * ring), k + 1, k], 1)
    ahead = np.stack([np.full(sides, 2 * ring + 1), k + ring, k + 1 + ring], 1)
    if not capped:
        back, ahead = back[:0], ahead[:0]
    return _TubeTopology(
        circle=np.stack([np.cos(angle), np.sin(angle)], -1),
        points=np.concatenate([walls, back, ahead]),
        normals=np.concatenate([walls % ring, np.full_like(back, ring), np.full_like(ahead, ring + 1)]),
        uv=np.concatenate([walls, back + 2 * ring, ahead + 2 * ring]),
    )


@functools.cache
def _cube() -> tuple[Float[np.ndarray, "12 3 3"], Float[np.ndarray, "12 3 3"]]:
    """Return the triangles and normals of a cube of side 2 centred on the origin."""
    corners = np.array(list(product((-1.0, 1.0), repeat=3)))
    triangles = corners[np.array(_CUBE_FACES)]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]) / 4
    return triangles, np.repeat(normals[:, None], 3, axis=1)


@functools.cache
def _ball(subdivisions: int) -> Float[np.ndarray, "n 3 3"]:
    """Return the triangles of a unit sphere.

    The sphere is an icosahedron, and each subdivision splits every triangle into four.
    """
    golden_ratio = (1 + math.sqrt(5)) / 2
    rectangle = np.array([(y, x * golden_ratio, 0) for x, y in product((1, -1), (-1, 1))])
    corners = np.concatenate([np.roll(rectangle, turn, axis=1) for turn in range(3)])
    corners /= math.hypot(1, golden_ratio)
    triangles = corners[np.array(_ICOSAHEDRON_FACES)]
    for _ in range(subdivisions):
        a, b, c = triangles.swapaxes(0, 1)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        parts = [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
        triangles = np.moveaxis(np.array(parts), 2, 0).reshape(-1, 3, 3)
        triangles = triangles / np.linalg.norm(triangles, axis=-1, keepdims=True)
    return triangles
