"""Embree ray caster for images and exact depth, slower than `opengl` and with fewer effects.

It is the fallback if OpenGL does not start, and the tests use it as an independent reference for the OpenGL
renderer.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Int, UInt8

from stereoweave.synth.rendering.effects import Effects
from stereoweave.synth.rendering.frustum import NEAR_M, rays
from stereoweave.synth.textures.bank import srgb_to_linear, texture_bank
from stereoweave.synth.viewpoints import PosedRig
from stereoweave.synth.world import Mesh, RenderedView, Sky, World

Vectors = Float[np.ndarray, "p 3"]

# Offset of shadow rays from the surface; prevents self-shadowing due to rounding errors.
_OFF_M = 2e-3


class Raycaster:
    """Ray-casting renderer of worlds; implements `pair_rendering.SceneRenderer`.

    It supports shadows with hard edges, fog, and several samples per pixel. Surfaces are diffuse, and clouds
    and lamps are ignored.
    """

    def __init__(self, effects: Effects = Effects()) -> None:  # noqa: B008, frozen
        self.effects = effects
        self._scene: EmbreeScene | None = None
        self._world: World | None = None

    @property
    def name(self) -> str:
        """Name and version of embree."""
        return f"embree {version('embreex')}"

    def depth_m(self, world: World, rig: PosedRig, position: float) -> Float[np.ndarray, "h w"]:
        """Return the depth in metres along the optical axis, float32 [H, W]; infinite for the sky."""
        return self.cast_rays(world, rig.eye_m(position), rays(rig))[0].astype(np.float32)

    def cast_rays(
        self, world: World, eye_m: Float[np.ndarray, "3"], directions: Float[np.ndarray, "h w 3"]
    ) -> tuple[Float[np.ndarray, "h w"], Int[np.ndarray, "h w"]]:
        """Cast rays from one point; return the distances and triangle indices of their hits.

        Distances are multiples of the directions' lengths. If a ray hits nothing, its distance is
        infinite and its triangle index is -1.
        """
        hits = self._cast(world, eye_m, directions.reshape(-1, 3))
        shape = directions.shape[:2]
        return hits.distance.reshape(shape), hits.triangle.reshape(shape)

    def render_views(self, world: World, rig: PosedRig, positions: Sequence[float]) -> list[RenderedView]:
        """Render an image with its ground truth at each position."""
        return [self._render_view(world, rig, position) for position in positions]

    def _render_view(self, world: World, rig: PosedRig, position: float) -> RenderedView:
        depth_m, triangle = self.cast_rays(world, rig.eye_m(position), rays(rig))
        target = (triangle >= 0) & world.mesh.target[triangle]
        image = self._render_image(world, rig, position)
        return RenderedView(image=image, depth_m=depth_m.astype(np.float32), target=target)

    def _render_image(self, world: World, rig: PosedRig, position: float) -> UInt8[np.ndarray, "h w 3"]:
        samples = self.effects.samples
        directions = rays(rig, samples)
        hits = self._cast(world, rig.eye_m(position), directions.reshape(-1, 3))
        ray_width = 1 / (rig.camera.focal_px * samples)
        light = self._shade(world, rig.eye_m(position), directions.reshape(-1, 3), hits, ray_width)
        height, width = rig.size_px[::-1]
        shown = _tone_map(world.exposure * light).reshape(height, samples, width, samples, 3).mean((1, 3))
        coded = np.where(shown < 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)
        return np.round(255 * coded).astype(np.uint8)

    def _cast(self, world: World, eye_m: Float[np.ndarray, "3"], directions: Vectors) -> "_Hits":
        if self._scene is None or self._world is not world:
            self._scene = EmbreeScene()
            TriangleMesh(self._scene, world.mesh.corners_m)
            self._world = world
        starts_m = eye_m + NEAR_M * directions
        triangle = self._scene.run(starts_m.astype(np.float32), directions.astype(np.float32))
        return _intersect_planes(world.mesh, eye_m, directions, triangle.astype(np.int64))

    def _shade(
        self,
        world: World,
        eye_m: Float[np.ndarray, "3"],
        directions: Vectors,
        hits: "_Hits",
        ray_width: float,
    ) -> Vectors:
        """Return the light from each direction; `ray_width` is the width of a ray at depth 1."""
        light = _sky_radiance(world.sky, directions)
        met = hits.triangle >= 0
        surface = hits.select(met)
        away_m = surface.distance[:, None] * directions[met]
        place_m = eye_m + away_m
        normal = _interpolate_normals(world.mesh, surface, directions[met])
        facing = np.maximum(normal @ np.array(world.sky.sun), 0)
        if self.effects.shadows and any(world.sky.sun_light):
            facing *= self._sun_visibility(world, place_m + _OFF_M * normal)
        received = _sky_irradiance(world.sky, normal) + facing[:, None] * np.array(world.sky.sun_light)
        given = _look_up_colours(world, surface, ray_width * surface.distance) * received
        if self.effects.fog and world.fog is not None:
            clear = np.exp(-world.fog.density_per_m * np.linalg.norm(away_m, axis=1))[:, None]
            given = clear * given + (1 - clear) * np.array(world.fog.colour)
        light[met] = given
        return light

    def _sun_visibility(self, world: World, places_m: Vectors) -> Float[np.ndarray, " p"]:
        """Return 1 where nothing blocks the sun, and 0 elsewhere."""
        assert self._scene is not None
        towards = np.broadcast_to(np.array(world.sky.sun, np.float32), places_m.shape)
        met = self._scene.run(places_m.astype(np.float32), np.ascontiguousarray(towards))
        return (met < 0).astype(np.float64)


@dataclass(frozen=True, kw_only=True)
class _Hits:
    """The first hit of each ray.

    Attributes:
        triangle: Index of the triangle; -1 if the ray hits nothing.
        distance: Distance as a multiple of the direction's length; infinite if the ray hits nothing.
        shares: Barycentric coordinates of the hit.
    """

    triangle: Int[np.ndarray, " p"]
    distance: Float[np.ndarray, " p"]
    shares: Vectors

    def select(self, chosen: np.ndarray) -> "_Hits":
        return _Hits(
            triangle=self.triangle[chosen], distance=self.distance[chosen], shares=self.shares[chosen]
        )


def _intersect_planes(
    mesh: Mesh, eye_m: np.ndarray, directions: Vectors, triangle: Int[np.ndarray, " p"]
) -> _Hits:
    """Intersect each ray with its triangle's plane in double precision; embree only finds the triangle."""
    met = triangle >= 0
    first, second, third = mesh.corners_m[triangle[met]].astype(np.float64).transpose(1, 0, 2)
    edge, other, from_first = second - first, third - first, eye_m - first
    across, lifted = np.cross(directions[met], other), np.cross(from_first, edge)
    size = (edge * across).sum(1)
    s = (from_first * across).sum(1) / size
    t = (directions[met] * lifted).sum(1) / size
    distance, shares = np.full(len(triangle), np.inf), np.zeros((len(triangle), 3))
    distance[met] = (other * lifted).sum(1) / size
    shares[met] = np.stack([1 - s - t, s, t], -1)
    return _Hits(triangle=triangle, distance=distance, shares=shares)


def _interpolate_normals(mesh: Mesh, hits: _Hits, directions: Vectors) -> Vectors:
    """Return the interpolated unit normals, flipped where needed to the side that the ray comes from."""
    first, second, third = mesh.corners_m[hits.triangle].transpose(1, 0, 2)
    face = np.cross(second - first, third - first)
    normal = np.einsum("pc,pcx->px", hits.shares, mesh.normals[hits.triangle])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    turned = (normal * face).sum(1) * (face * directions).sum(1) > 0
    return np.where(turned[:, None], -normal, normal)


def _look_up_colours(world: World, hits: _Hits, ray_m: Float[np.ndarray, " p"]) -> Vectors:
    """Return the albedo at each hit; `ray_m` is the width of the ray at the hit."""
    material = world.mesh.material[hits.triangle]
    uv_m = np.einsum("pc,pcx->px", hits.shares, world.mesh.uv_m[hits.triangle])
    colours = np.empty((len(material), 3))
    for index in np.unique(material):
        chosen = material == index
        made = world.materials[index]
        levels = _mipmaps(texture_bank().layer(made.texture, made.variant))
        side = len(levels[0])
        spans = uv_m[chosen] * [1, -1] / made.span_m
        level = np.log2(np.maximum(ray_m[chosen] / made.span_m * side, 1)).round().astype(int)
        level = np.minimum(level, len(levels) - 1)
        texel = np.floor((spans % 1) * (side >> level)[:, None]).astype(int).T
        own = np.empty((len(level), 3))
        for k in np.unique(level):
            column, row = np.minimum(texel[:, level == k], len(levels[k]) - 1)
            own[level == k] = levels[k][row, column]
        colours[chosen] = np.array(made.tint) * own
    return colours


@functools.lru_cache(maxsize=24)
def _mipmaps(layer: int) -> list[Float[np.ndarray, "side side 3"]]:
    """Return a texture's mipmaps in linear light, from fine to coarse."""
    levels = [srgb_to_linear(texture_bank().pixels[layer, ..., :3].astype(np.float32))]
    while len(levels[-1]) > 1:
        half = len(levels[-1]) // 2
        levels.append(levels[-1].reshape(half, 2, half, 2, 3).mean((1, 3)))
    return levels


def _sky_radiance(sky: Sky, directions: Vectors) -> Vectors:
    """Return the sky's radiance from the given directions, as in shaders/light.glsl."""
    height = (directions[:, 2] / np.linalg.norm(directions, axis=1))[:, None]
    zenith, horizon, ground = (np.array(colour) for colour in (sky.zenith, sky.horizon, sky.ground))
    up = np.maximum(height, 0)
    above = horizon + 1.3 * up / (up + 0.3) * (zenith - horizon)
    below = np.clip(-height / 0.12, 0, 1)
    return above + below**2 * (3 - 2 * below) * (ground - above)


def _sky_irradiance(sky: Sky, normals: Vectors) -> Vectors:
    """Return the sky's irradiance on surfaces with the given normals, as in shaders/light.glsl."""
    zenith, horizon, ground = (np.array(colour) for colour in (sky.zenith, sky.horizon, sky.ground))
    up = 0.5 + 0.5 * normals[:, 2:]
    upper = horizon + 0.7 * up * (zenith - horizon)
    return (1 - up) * ((1 - up) * ground + up * horizon) + up * upper


def _tone_map(exposed: Vectors) -> Vectors:
    dense = exposed**1.5
    return dense / (dense + 0.25)
