"""Geometry for shadows and ambient occlusion: the sun's view and a grid of surface areas.

Triangles are passed as a contiguous `Mesh.corners_m.T`, indexed by axis, corner and triangle.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

Corners = Float[np.ndarray, "3 3 _"]

# Number of grid cells along each axis; a cell is 18 cm wide if the target is 8 m long.
CELLS = 64
# Margin between the target and the grid's border, in cells.
_SPARE_CELLS = 8
# Triangles larger than this, in areas of a cell's face, are subdivided.
_LARGE_CELLS = 64
# Side, in cells, of the cube whose surfaces occlude its centre: 1.65 m if the target is 8 m long.
_WIDE_CELLS = 9


@dataclass(frozen=True, kw_only=True)
class SunView:
    """The sun's orthographic view: an inner square around the target and a wider, concentric square.

    Attributes:
        to_unit: Matrix [3, 4] from (x, y, z, 1) to coordinates in 0..1: across the inner square, down the
            inner square, and away from the sun.
        inner_m: Side of the inner square.
        wide: Ratio of the wide square's side to the inner square's side.
        inside: Indices of the triangles that cast shadows into the inner square.
        beyond: Indices of the triangles that cast shadows into the wide square and are not entirely in the
            inner square.
    """

    to_unit: Float[np.ndarray, "3 4"]
    inner_m: float
    wide: float
    inside: Int[np.ndarray, " k"]
    beyond: Int[np.ndarray, " l"]


def fit_sun_view(
    corners_m: Corners, target_m: Corners, sun: tuple[float, float, float], reach_m: float
) -> SunView:
    """Fit the sun's view to the target.

    Seen along the sun's rays, a target covers its own shadow, so one square contains both.
    """
    axes = _sun_axes(np.array(sun))
    low, high = _extent(_rotate(target_m, axes))
    middle = (low + high) / 2
    half_m = 1.04 * float((high - low)[:2].max()) / 2
    across, down, away = _rotate(corners_m, axes)
    near = np.stack([across - middle[0], down - middle[1]])
    lowest, highest = near.min(1), near.max(1)
    inside = ((highest > -half_m) & (lowest < half_m)).all(0)
    within = ((lowest > -half_m) & (highest < half_m)).all(0)
    wide_m = max(reach_m, half_m)
    beyond = ((highest > -wide_m) & (lowest < wide_m)).all(0) & ~within
    spare_m = 0.01 + 0.01 * float(away.max() - away.min())
    start = np.array([middle[0] - half_m, middle[1] - half_m, away.min() - spare_m])
    span = np.array([2 * half_m, 2 * half_m, away.max() - away.min() + 2 * spare_m])
    return SunView(
        to_unit=np.column_stack([axes / span[:, None], -start / span]),
        inner_m=2 * half_m,
        wide=wide_m / half_m,
        inside=np.flatnonzero(inside),
        beyond=np.flatnonzero(beyond),
    )


def _sun_axes(sun: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation [3, 3] whose rows are two axes across the sun's rays and the rays' direction."""
    across = np.cross([0, 1, 0] if abs(sun[2]) > 0.9 else [0, 0, 1], sun)
    across = across / np.linalg.norm(across)
    return np.stack([across, np.cross(sun, across), -sun])


def _rotate(corners_m: Corners, axes: Float[np.ndarray, "3 3"]) -> Corners:
    return (axes.astype(np.float32) @ corners_m.reshape(3, -1)).reshape(corners_m.shape)


def _extent(corners_m: Corners) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    return corners_m.min((1, 2)), corners_m.max((1, 2))


@dataclass(frozen=True, kw_only=True)
class OcclusionGrid:
    """Ambient occlusion around the target.

    Attributes:
        share: Blocked fraction of the sky, uint8 [CELLS, CELLS, CELLS] indexed by z, y and x; 255 means the
            whole sky.
        low_m: The grid's corner with the smallest x, y and z.
        cell_m: Side of a cell.
    """

    share: UInt8[np.ndarray, "z y x"]
    low_m: Float[np.ndarray, "3"]
    cell_m: float


def count_occlusion(corners_m: Corners, target_m: Corners) -> OcclusionGrid:
    """Estimate ambient occlusion from each cell's surface area, sampled at points on the triangles."""
    low, high = _extent(target_m)
    cell_m = 1.1 * float((high - low).max()) / (CELLS - 2 * _SPARE_CELLS)
    low_m = (low + high) / 2 - np.float32(cell_m * CELLS / 2)
    points, areas = _sample_points(_cut_large(corners_m, low_m, cell_m), cell_m)
    place = ((points - low_m[:, None]) / np.float32(cell_m)).astype(np.int32)
    x, y, z = place
    inside = ((place >= 0) & (place < CELLS)).all(0)
    index = ((z * CELLS + y) * CELLS + x)[inside]
    counted = np.bincount(index, areas[inside] / cell_m**2, CELLS**3).astype(np.float32)
    surface = np.minimum(counted, 1).reshape(CELLS, CELLS, CELLS)
    return OcclusionGrid(share=_hidden_share(surface), low_m=low_m, cell_m=cell_m)


def _hidden_share(surface: Float[np.ndarray, "z y x"]) -> UInt8[np.ndarray, "z y x"]:
    """Return the fraction of the sky that nearby surfaces block from each cell.

    Surfaces in the cell itself count most; surfaces in the cube around the cell count less. A plane blocks no
    sky from points on it, so the area of one plane is subtracted from the area in the cube.
    """
    around = surface
    for axis in range(3):
        layers = np.moveaxis(around, axis, 0)
        blurred = cv2.blur(layers.reshape(CELLS, -1), (1, _WIDE_CELLS), borderType=cv2.BORDER_CONSTANT)
        around = np.moveaxis(blurred.reshape(layers.shape), 0, axis)
    hidden = 0.35 * surface + 5 * np.maximum(around - 1.2 / _WIDE_CELLS, 0)
    # The border stays 0, because a lookup outside the grid returns the value at the border.
    inner = np.zeros_like(hidden)
    inner[1:-1, 1:-1, 1:-1] = hidden[1:-1, 1:-1, 1:-1]
    return (255 * np.minimum(inner, 0.85)).astype(np.uint8)


def _cut_large(corners_m: Corners, low_m: Float[np.ndarray, "3"], cell_m: float) -> Corners:
    """Return the triangles that touch the grid, with large ones subdivided so that few samples miss it."""
    done = []
    rest = _select_near(corners_m, low_m, cell_m * CELLS)
    while rest.size:
        large = _areas(rest) > _LARGE_CELLS * cell_m**2
        done.append(rest[..., ~large])
        rest = _select_near(_quarter(rest[..., large]), low_m, cell_m * CELLS)
    return np.concatenate(done, axis=-1)


def _select_near(corners_m: Corners, low_m: Float[np.ndarray, "3"], side_m: float) -> Corners:
    low = low_m[:, None]
    near = ((corners_m.max(1) > low) & (corners_m.min(1) < low + np.float32(side_m))).all(0)
    return corners_m[..., near]


def _quarter(corners_m: Corners) -> Corners:
    """Split each triangle into four at the midpoints of its edges."""
    a, b, c = corners_m.transpose(1, 0, 2)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return np.concatenate([np.stack(part, 1) for part in parts], axis=-1)


def _areas(corners_m: Corners) -> Float[np.ndarray, " p"]:
    edge, other = corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0]
    normal = edge[[1, 2, 0]] * other[[2, 0, 1]] - edge[[2, 0, 1]] * other[[1, 2, 0]]
    return np.sqrt((normal**2).sum(0)) / 2


def _sample_points(
    corners_m: Corners, cell_m: float
) -> tuple[Float[np.ndarray, "3 p"], Float[np.ndarray, " p"]]:
    """Return sample points on the triangles, about two per cell, and the area that each point represents."""
    first = corners_m[:, 0]
    edge, other = corners_m[:, 1] - first, corners_m[:, 2] - first
    areas = _areas(corners_m)
    counts = np.maximum(np.ceil(areas * np.float32(2 / cell_m**2)), 1).astype(np.int32)
    which = np.repeat(np.arange(len(areas)), counts)
    # Roberts's R2 sequence (2018) fills a square evenly; folded, it fills a triangle.
    number = np.arange(len(which))
    s, t = ((number * step % 1).astype(np.float32) for step in (0.7548776662, 0.5698402910))
    folded = s + t > 1
    s, t = np.where(folded, 1 - s, s), np.where(folded, 1 - t, t)
    return first[:, which] + s * edge[:, which] + t * other[:, which], (areas / counts)[which]
