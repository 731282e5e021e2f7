"""A room rendered by ray casting for VR180 and 360-degree cameras, also the scene of the tests."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

# Half extents of the room in baselines: to the sides, up and down, and ahead and behind.
ROOM = np.array([40.0, 25.0, 30.0])


Rays = Float[np.ndarray, "h w 3"]
Distances = Float[np.ndarray, "h w"]
Image = UInt8[np.ndarray, "h w 3"]
Place = Float[np.ndarray, "..."]


class SpherePair(NamedTuple):
    """Both eyes' images, uint8 [H, W, 3], and the left eye's distances along its rays, in baselines."""

    left: Image
    right: Image
    distance: Distances


def look_equirectangular(size_px: tuple[int, int], width_deg: float = 180.0) -> Rays:
    """Return the unit direction of each pixel of an equirectangular image [H, W, 3]; y is down."""
    width_px, height_px = size_px
    yaw = np.radians(((np.arange(width_px) + 0.5) / width_px - 0.5) * width_deg)[None, :]
    pitch = np.radians((0.5 - (np.arange(height_px) + 0.5) / height_px) * 180)[:, None]
    x, z = np.cos(pitch) * np.sin(yaw), np.cos(pitch) * np.cos(yaw)
    return np.stack([x, np.broadcast_to(-np.sin(pitch), x.shape), z], axis=-1)


def look_fisheye(side_px: int, lens_fov_deg: float) -> Rays:
    """Return the unit direction of each pixel of an equidistant fisheye image [H, W, 3]."""
    place = np.arange(side_px) - (side_px - 1) / 2
    x, y = np.meshgrid(place, place)
    radius = np.maximum(np.hypot(x, y), 1e-9)
    angle = radius / (side_px / 2) * np.radians(lens_fov_deg) / 2
    return np.stack([np.sin(angle) * x / radius, np.sin(angle) * y / radius, np.cos(angle)], axis=-1)


def cast(rays: Rays, eye: Place, rng_seed: int = 0) -> tuple[Image, Distances]:
    """Return the colours and the distances of a textured room's walls, seen from `eye` [..., 3]."""
    eye = np.broadcast_to(eye, rays.shape)
    with np.errstate(divide="ignore"):
        steps = (np.sign(rays) * ROOM - eye) / rays
    steps = np.where(np.abs(rays) > 1e-12, steps, np.inf)
    distance = steps.min(axis=-1)
    points = eye + distance[..., None] * rays
    return _paint(points, steps.argmin(axis=-1), rng_seed), distance


def _paint(points: Rays, walls: Int[np.ndarray, "h w"], rng_seed: int) -> Image:
    """Return a smooth random texture of three colours on each wall, without a period in sight."""
    rng = np.random.default_rng(rng_seed)
    colours = np.zeros(points.shape, np.float32)
    for wall in range(3):
        on_wall = walls == wall
        waves = rng.normal(size=(10, 3)) * np.geomspace(0.25, 2.2, 10)[:, None]
        tones = np.sin((points[on_wall] @ waves.T + rng.uniform(0, 7, 10)).astype(np.float32))
        colours[on_wall] = tones @ rng.normal(size=(10, 3)).astype(np.float32)
    return np.clip(128 + 28 * colours, 0, 255).astype(np.uint8)


def render_fixed(rays: Rays) -> SpherePair:
    """Return the room as two fixed eyes at x = -1/2 and 1/2 baseline see it along the same rays."""
    left, distance = cast(rays, np.array([-0.5, 0, 0]))
    right, _ = cast(rays, np.array([0.5, 0, 0]))
    return SpherePair(left, right, distance)


def render_turning(size_px: tuple[int, int]) -> SpherePair:
    """Return the room as eyes that turn with the direction of view see it, over 360 degrees."""
    rays = look_equirectangular(size_px, 360.0)
    yaw = np.arctan2(rays[..., 0], rays[..., 2])
    aside = np.stack([np.cos(yaw), np.zeros_like(yaw), -np.sin(yaw)], axis=-1) / 2
    left, distance = cast(rays, -aside)
    right, _ = cast(rays, aside)
    return SpherePair(left, right, distance)
