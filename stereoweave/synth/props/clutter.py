"""Clutter: many near and far objects, standing or floating, in the cameras' field of view."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.furniture import FURNITURE
from stereoweave.synth.props.primitives import rotation
from stereoweave.synth.props.random_materials import draw_material
from stereoweave.synth.props.solids import SOLIDS, PropBuilder, PropStyle
from stereoweave.synth.props.thin_things import THIN
from stereoweave.synth.stage import Palette
from stereoweave.synth.viewpoints import Orbit
from stereoweave.synth.world import Mesh

COUNT = (15, 40)
_SIZES_M = (0.05, 1.5)
_NEAREST_M = 0.75
# Object size as a fraction of the distance, so that objects look equally large at all depths.
_SIZE_PER_DISTANCE = (0.05, 0.55)
_TYPICAL_FOCAL_PX = 600
_THIN_PX = (1.0, 6.0)
_CANDIDATES = 24
_CLEAR_M = 0.6  # smallest gap between a camera and an object


@dataclass(frozen=True, kw_only=True)
class ClutterSpace:
    """Space to fill with clutter.

    Attributes:
        orbit: orbit of the cameras; objects keep clear of all viewpoints on it.
        low_m, high_m: [3], corners of the box that contains the objects; the floor is at low_m[2].
        far_m: largest distance between a camera and an object.
        count: minimum and maximum number of objects.
        standing: fraction of the objects that stand on the floor.
    """

    orbit: Orbit
    low_m: Float[np.ndarray, "3"]
    high_m: Float[np.ndarray, "3"]
    far_m: float
    count: tuple[int, int] = COUNT
    standing: float = 0.4

    def eyes_m(self) -> Float[np.ndarray, "n 3"]:
        """Return camera positions [N, 3] sampled over the whole orbit."""
        orbit = self.orbit
        ranges = (orbit.distance_m, orbit.azimuth_deg, orbit.elevation_deg)
        grids = np.meshgrid(*(np.linspace(start, end, 3) for start, end in ranges))
        distance, azimuth, elevation = (grid.ravel() for grid in grids)
        azimuth, elevation = np.radians(azimuth), np.radians(elevation)
        level = np.cos(elevation)
        outwards = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], -1)
        eyes_m = np.array(orbit.centre_m) + distance[:, None] * outwards
        eyes_m[:, 2] = np.maximum(eyes_m[:, 2], orbit.floor_m)
        return eyes_m


@dataclass(frozen=True, kw_only=True)
class _ClutterPlacement:
    """Position and size of an object.

    Attributes:
        middle_m: [3], centre of the object.
        distance_m: distance from the nearest camera.
        size_m: longest side of the object.
        standing: whether the object stands on the floor.
    """

    middle_m: Float[np.ndarray, "3"]
    distance_m: float
    size_m: float
    standing: bool


def clutter(rng: np.random.Generator, palette: Palette, space: ClutterSpace) -> list[Mesh]:
    """Build random objects, 5 cm to 1.5 m in size.

    In half of all scenes, a quarter to half of the objects are thin, with bars 1 to 6 px thick.
    """
    count = int(rng.integers(space.count[0], space.count[1] + 1))
    thin_share = rng.uniform(0.25, 0.5) if rng.random() < 0.5 else 0.0
    bars_px = _log_uniform(rng, *_THIN_PX, (count,))
    things, skins = [], []
    for place, bar_px in zip(_draw_placements(rng, space, count), bars_px, strict=True):
        skins.append(palette.add(draw_material(rng, place.distance_m)))
        bar_m = bar_px / 2 * place.distance_m / _TYPICAL_FOCAL_PX
        other = skins[rng.integers(len(skins))]
        style = PropStyle(main=skins[-1], other=other, bar_m=min(float(bar_m / place.size_m), 0.05))
        things.append(_place_mesh(rng, _draw_kind(rng, thin_share)(rng, style), place, float(space.low_m[2])))
    return things


def _log_uniform(rng: np.random.Generator, low: float, high: float, shape: tuple[int, ...]) -> np.ndarray:
    return np.exp(rng.uniform(np.log(low), np.log(high), shape))


def _draw_kind(rng: np.random.Generator, thin_share: float) -> PropBuilder:
    """Draw a random kind of object; with probability `thin_share`, the object is thin."""
    others = SOLIDS if rng.random() < 0.65 else FURNITURE
    kinds = THIN if rng.random() < thin_share else others
    return kinds[rng.integers(len(kinds))]


def _draw_placements(rng: np.random.Generator, space: ClutterSpace, count: int) -> list[_ClutterPlacement]:
    """Place objects in order of decreasing apparent size.

    Each object takes the best of several candidate positions; clearance from the cameras matters more than
    clearance from other objects. Objects too close to a camera are shrunk.
    """
    eyes_m = space.eyes_m()
    shape = (count, _CANDIDATES)
    sizes = np.sort(_log_uniform(rng, *_SIZE_PER_DISTANCE, (count,)))[::-1]
    standing = rng.random(count) < space.standing
    depths_m = _log_uniform(rng, _NEAREST_M, space.far_m, shape)
    sizes_m = np.clip(sizes[:, None] * depths_m, *_SIZES_M)
    spots = _points_in_view(rng, space, eyes_m[rng.integers(len(eyes_m), size=shape)], depths_m)
    half_m = 0.45 * sizes_m[..., None]
    spots = np.clip(spots, space.low_m + half_m, space.high_m - half_m)
    spots[standing, :, 2] = space.low_m[2] + sizes_m[standing] / 2
    clear_m = np.sqrt(np.square(spots[:, :, None] - eyes_m).sum(-1).min(-1))
    safe_m = np.minimum(clear_m - _CLEAR_M - 0.55 * sizes_m, 0)
    taken, radii_m, places = np.full((count, 3), np.inf), np.zeros(count), []
    for k in range(count):
        apart_m = np.sqrt(np.square(spots[k, :, None] - taken[:k]).sum(-1)) - radii_m[:k]
        best = int((9 * safe_m[k] + np.minimum(apart_m.min(1, initial=9) - 0.4 * sizes_m[k], 0)).argmax())
        size_m = min(sizes_m[k, best], max(clear_m[k, best] - _CLEAR_M, 0.03) / 0.55)
        taken[k], radii_m[k] = spots[k, best], 0.4 * size_m
        places.append(
            _ClutterPlacement(
                middle_m=spots[k, best],
                distance_m=float(clear_m[k, best]),
                size_m=float(size_m),
                standing=bool(standing[k]),
            )
        )
    return places


def _points_in_view(
    rng: np.random.Generator,
    space: ClutterSpace,
    eyes_m: Float[np.ndarray, "n k 3"],
    depths_m: Float[np.ndarray, "n k"],
) -> Float[np.ndarray, "n k 3"]:
    """Draw points [N, K, 3] in the fields of view of cameras that look at the orbit's centre."""
    forward = np.array(space.orbit.centre_m) - eyes_m
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    # Focal lengths are drawn later, so the points cover both narrow and wide fields of view.
    reach = rng.uniform(0.25, 0.6, depths_m.shape)
    x, y = reach * rng.uniform(-1, 1, depths_m.shape), 0.75 * reach * rng.uniform(-1, 1, depths_m.shape)
    seen = forward + x[..., None] * right + y[..., None] * np.cross(right, forward)
    return eyes_m + depths_m[..., None] * seen


def _place_mesh(rng: np.random.Generator, mesh: Mesh, place: _ClutterPlacement, floor_m: float) -> Mesh:
    """Rotate a mesh, scale it together with its texture, and move it to its position.

    Standing objects are moved onto the floor.
    """
    low, high = mesh.corners_m.min((0, 1)), mesh.corners_m.max((0, 1))
    scale = place.size_m / float((high - low).max())
    axis = np.array([0, 0, 1]) if place.standing else rng.normal(size=3)
    pose = rotation(tuple(axis.tolist()), rng.uniform(0, 360))
    pose[:3, :3] *= scale
    pose[:3, 3] = place.middle_m - pose[:3, :3] @ ((low + high) / 2)
    if place.standing:
        pose[2, 3] = floor_m - scale * float(low[2])
    return replace(mesh.transform(pose), uv_m=mesh.uv_m * np.float32(scale))
