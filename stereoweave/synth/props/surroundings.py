"""Surroundings of the targets: daylight, ground, water, trees, houses, and goods in yards and on quays.

Functions that build meshes add their materials to the palette. Objects stand at the given spots, usually at
z = 0. Most objects extend slightly below the ground, so no gaps show where the ground is uneven.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.primitives import (
    boxes,
    copies,
    facets,
    lathe,
    prism,
    rotation,
    sheet,
    spheres,
    translation,
    tubes,
)
from stereoweave.synth.stage import Daylight, Palette
from stereoweave.synth.world import Colour, Fog, Material, Mesh, Sky, join_meshes

Spots = Float[np.ndarray, "n 3"]

_GROUND_TINTS: dict[str, tuple[Colour, float]] = {  # tint, and span of the texture in metres
    "grass": ((1.0, 1.0, 0.9), 5.0),
    "soil": ((1.0, 0.97, 0.93), 5.0),
    "gravel": ((0.9, 0.88, 0.85), 3.0),
    "asphalt": ((1.0, 1.0, 1.02), 7.0),
    "concrete": ((0.9, 0.89, 0.86), 7.0),
    "plain": ((0.45, 0.42, 0.36), 9.0),
}


def daylight(rng: np.random.Generator) -> Daylight:
    """Draw random daylight: a clear, hazy or overcast sky, or a low, warm sun."""
    kind = rng.choice(["clear", "hazy", "overcast", "low"], p=[0.4, 0.25, 0.15, 0.2])
    height_deg = rng.uniform(15, 26) if kind == "low" else rng.uniform(30, 65)
    azimuth, height = rng.uniform(0, 2 * np.pi), np.radians(height_deg)
    sun = (np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height))
    strength = rng.uniform(0.9, 1.1)
    sun_light, zenith, horizon, clouds = {
        "clear": ((2.6, 2.45, 2.2), (0.26, 0.38, 0.62), (0.62, 0.72, 0.85), rng.uniform(0.1, 0.55)),
        "hazy": ((1.9, 1.8, 1.6), (0.42, 0.5, 0.62), (0.82, 0.84, 0.85), rng.uniform(0.3, 0.7)),
        "overcast": ((0.25, 0.25, 0.25), (0.75, 0.79, 0.85), (0.9, 0.92, 0.95), rng.uniform(0.8, 1.0)),
        "low": ((2.5, 1.85, 1.2), (0.27, 0.36, 0.55), (0.9, 0.76, 0.6), rng.uniform(0.2, 0.6)),
    }[kind]
    sky = Sky(
        sun=tuple(float(v) for v in sun),  # type: ignore[arg-type]
        sun_light=_scale_colour(sun_light, strength),
        zenith=zenith,
        horizon=horizon,
        ground=(0.2, 0.18, 0.15),
        cloud_variant=int(rng.choice({"overcast": [3], "hazy": [1, 3]}.get(kind, [0, 1, 2]))),
        clouds=float(clouds),
    )
    density = {"clear": 0.0, "hazy": 0.0035, "overcast": 0.0015, "low": 0.001}[kind] * rng.uniform(0.5, 1.2)
    fog = Fog(colour=_scale_colour(horizon, 0.9), density_per_m=density) if density else None
    return Daylight(sky, fog, float(rng.uniform(0.85, 1.1)))


def terrain(  # noqa: PLR0913 - family and dimensions
    rng: np.random.Generator,
    palette: Palette,
    family: str,
    *,
    extent_m: float = 120.0,
    level_m: float = 0.0,
    bumps_m: float = 0.3,
    flat_radius_m: float = 5.0,
) -> Mesh:
    """Build ground that extends extent_m in each direction, flat around the origin and bumpy farther out.

    family: texture family "grass", "soil", "gravel", "asphalt", "concrete", or "plain" for sand and snow.
    """
    tint, span_m = _GROUND_TINTS[family]
    material = palette.add(
        Material(
            texture=family,
            variant=int(rng.integers(64)),
            tint=vary_colour(rng, tint),
            span_m=span_m,
            roughness=0.95,
            relief=0.6,
        )
    )
    x, y = _widening_grid(extent_m, near_m=8.0, steps=44)
    bumps = sum(
        np.sin((x * np.cos(way) + y * np.sin(way)) * 2 * np.pi / length + phase)
        for way, length, phase in zip(
            rng.uniform(0, 2 * np.pi, 5), rng.uniform(9, 45, 5), rng.uniform(0, 6, 5), strict=True
        )
    )
    away = np.clip((np.hypot(x, y) - flat_radius_m) / max(flat_radius_m, 1), 0, 1)
    height = level_m + bumps_m / 5 * bumps * away * away * (3 - 2 * away)
    return _map_texture_from_above(sheet(np.stack([x, y, height], -1), material))


def sea(rng: np.random.Generator, palette: Palette, *, extent_m: float = 200.0, level_m: float = 0.0) -> Mesh:
    """Build water that extends extent_m in each direction, with the highest waves near the origin."""
    tint: Colour = [(0.7, 0.75, 0.75), (0.8, 0.8, 0.65), (0.9, 0.8, 0.75)][int(rng.integers(3))]
    material = palette.add(
        Material(
            texture="water",
            variant=int(rng.integers(64)),
            tint=vary_colour(rng, tint),
            span_m=rng.uniform(4, 7),
            roughness=0.12,
            relief=rng.uniform(0.5, 0.9),
        )
    )
    x, y = _widening_grid(extent_m, near_m=4.0, steps=60)
    wind, roughness_m = rng.uniform(0, 2 * np.pi), rng.uniform(0.4, 1.0)
    height = np.full_like(x, level_m)
    for length in np.geomspace(2.2, 16, 8) * rng.uniform(0.9, 1.1, 8):
        way, phase = wind + rng.normal(0, 0.5), rng.uniform(0, 6)
        # Far from the origin, the grid is too coarse to represent short waves.
        carried = np.clip(1.5 - np.maximum(abs(x), abs(y)) * 0.2 / length, 0, 1)
        wave = np.sin((x * np.cos(way) + y * np.sin(way)) * 2 * np.pi / length + phase)
        height += 0.008 * roughness_m * length * carried * wave
    return _map_texture_from_above(sheet(np.stack([x, y, height], -1), material))


def hills(rng: np.random.Generator, palette: Palette, *, distance_m: float = 140.0) -> Mesh:
    """Build a distant ring of wooded hills with a crest up to about 16 m high."""
    material = palette.add(
        Material(
            texture="leaves",
            variant=int(rng.integers(64)),
            tint=vary_colour(rng, (0.85, 0.86, 0.86)),
            span_m=14.0,
            roughness=1.0,
            relief=0.8,
        )
    )
    angle = -np.linspace(0, 2 * np.pi, 129)
    crest = 0.35 + sum(
        rng.uniform(0.5, 1) / k**0.7 * np.sin(k * angle + rng.uniform(0, 6)) for k in (2, 3, 5, 8, 13, 29, 47)
    )
    crest = rng.uniform(5, 9) * (1 + 0.9 * np.tanh(crest))
    rise = np.array([0, 0.45, 0.8, 1.0, 0.85])[:, None]
    away = (
        distance_m
        + np.array([0, 6, 14, 26, 45])[:, None]
        + rng.normal(0, 1.2, (5, 128)).repeat(1, 1)[:, np.arange(129) % 128]
    )
    rough = rng.normal(0, 0.5, (5, 128))[:, np.arange(129) % 128] * (rise > 0)
    points = np.stack([away * np.cos(angle), away * np.sin(angle), rise * crest + rough - 1.0], -1)
    return sheet(points, material, closed=True)


def draw_spots(rng: np.random.Generator, count: int, nearest_m: float, farthest_m: float) -> Spots:
    """Draw spots [count, 3] at z = 0 that are spread evenly over a ring around the origin."""
    # A jittered sunflower pattern gives every spot the same area.
    order = np.arange(count)
    ring = farthest_m**2 - nearest_m**2
    radius = np.sqrt(nearest_m**2 + ring * (order + rng.uniform(0.2, 0.8, count)) / max(count, 1))
    apart = np.sqrt(np.pi * ring / max(count, 1))
    jitter = rng.uniform(-0.25, 0.25, count) * apart / np.maximum(radius, apart)
    angle = rng.uniform(0, 2 * np.pi) + order * np.pi * (3 - np.sqrt(5)) + jitter
    spots = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)], -1)
    return spots[rng.permutation(count)]


def trees(
    rng: np.random.Generator, palette: Palette, spots: Spots, height_m: tuple[float, float] = (4, 9)
) -> Mesh:
    """Build broad-leaved trees and firs at the spots.

    height_m: minimum and maximum height.
    """
    bark = palette.add(Material(texture="bark", variant=int(rng.integers(64)), span_m=1.5, relief=0.8))
    leaves = [_add_foliage(rng, palette) for _ in range(2)]
    kinds = [_tree(rng, bark, leaves[0], 0.42), _tree(rng, bark, leaves[1], 0.36), _fir(rng, bark, leaves[0])]
    return _scatter(rng, kinds, spots, rng.uniform(*height_m, len(spots)))


def bushes(rng: np.random.Generator, palette: Palette, spots: Spots) -> Mesh:
    """Build bushes, about 0.5 to 2 m high, at the spots."""
    leaves = _add_foliage(rng, palette)
    middles = rng.uniform((-0.35, -0.35, 0.2), (0.35, 0.35, 0.6), (2, 3, 3))
    shapes = [_lumps(rng, places, (0.42, 0.42, 0.38), leaves) for places in middles]
    kinds = [join_meshes([shape, _tufts(rng, shape, 50, 0.09)]) for shape in shapes]
    return _scatter(rng, kinds, spots, rng.uniform(0.6, 1.8, len(spots)))


def rocks(rng: np.random.Generator, palette: Palette, spots: Spots) -> Mesh:
    """Build half-buried boulders, about 0.3 to 1.5 m across, at the spots."""
    stone = palette.add(Material(texture="stone", variant=int(rng.integers(64)), relief=0.7, roughness=0.9))
    kinds = [_lumps(rng, np.zeros((1, 3)), rng.uniform(0.3, 0.55, 3), stone) for _ in range(3)]
    return _scatter(rng, kinds, spots, rng.uniform(0.4, 1.5, len(spots)))


def houses(rng: np.random.Generator, palette: Palette, spots: Spots) -> Mesh:
    """Build houses of two kinds at the given positions, with gable roofs, windows, doors and chimneys."""
    kinds = [_house(rng, palette) for _ in range(2)]
    return _scatter(rng, kinds, spots, rng.uniform(0.9, 1.25, len(spots)))


def posts(rng: np.random.Generator, palette: Palette, spots: Spots, height_m: float = 1.2) -> Mesh:
    """Build wooden posts at the given positions."""
    wood = palette.add(Material(texture="wood", variant=int(rng.integers(64)), tint=(1.0, 0.95, 0.9)))
    tops = spots + np.array([0, 0, height_m]) + rng.normal(0, 0.03, (len(spots), 3))
    return tubes(spots - [0, 0, 0.5], tops, rng.uniform(0.06, 0.1, len(spots)), wood, sides=8)


def fence(rng: np.random.Generator, palette: Palette, corners_m: Spots) -> Mesh:
    """Build a fence of posts and rails along corners [N, 3], with a post about every 2 m."""
    steps = [
        np.linspace(a, b, max(int(np.linalg.norm(b - a) / 2), 1), endpoint=False)
        for a, b in zip(corners_m[:-1], corners_m[1:], strict=True)
    ]
    line = np.concatenate([*steps, corners_m[-1:]])
    height = rng.uniform(0.9, 1.3)
    steel = palette.add(Material(texture="steel", variant=int(rng.integers(64)), roughness=0.5, metal=0.8))
    rails = [
        tubes(line[:-1] + [0, 0, height * share], line[1:] + [0, 0, height * share], 0.02, steel)
        for share in (0.35, 0.65, 0.97)
    ]
    return join_meshes([tubes(line - [0, 0, 0.5], line + [0, 0, height], 0.03, steel), *rails])


def crates(rng: np.random.Generator, palette: Palette, spots: Spots) -> Mesh:
    """Build wooden crates at the spots, some in stacks of two."""
    wood = palette.add(Material(texture="wood", variant=int(rng.integers(64)), tint=(1.1, 1.02, 0.9)))
    frame = palette.add(Material(texture="wood", variant=int(rng.integers(64)), tint=(0.8, 0.7, 0.6)))
    lower = _crate(wood, frame)
    upper = _crate(wood, frame).transform(
        translation(0.05, 0.03, 1.0) @ rotation((0, 0, 1), rng.uniform(5, 40))
    )
    return _scatter(rng, [lower, join_meshes([lower, upper])], spots, rng.uniform(0.6, 1.0, len(spots)))


def pallets(rng: np.random.Generator, palette: Palette, spots: Spots) -> Mesh:
    """Build single pallets and stacks of four at the spots."""
    wood = palette.add(Material(texture="wood", variant=int(rng.integers(64)), tint=(1.1, 1.0, 0.88)))
    boards = boxes([[0, y, 0.13] for y in np.linspace(-0.35, 0.35, 6)], (1.2, 0.1, 0.022), wood)
    beams = boxes([[x, 0, 0.06] for x in (-0.55, 0, 0.55)], (0.1, 0.8, 0.12), wood)
    one = join_meshes([boards, beams])
    kinds = [copies(one, np.stack([translation(z=0.145 * k) for k in range(layers)])) for layers in (1, 4)]
    return _scatter(rng, kinds, spots, np.ones(len(spots)))


def barrels(rng: np.random.Generator, palette: Palette, spots: Spots) -> Mesh:
    """Build painted and rusty steel drums, 0.9 m high, at the spots."""
    profile = [(0, 0), (0.29, 0), (0.29, 0.3), (0.305, 0.31), (0.29, 0.32), (0.29, 0.58), (0.305, 0.59)]
    profile += [(0.29, 0.6), (0.29, 0.88), (0.27, 0.88), (0.27, 0.86), (0, 0.86)]
    kinds = [
        lathe(profile, _add_paint(rng, palette), 16),
        lathe(profile, _add_paint(rng, palette, "rust"), 16),
    ]
    return _scatter(rng, kinds, spots, np.ones(len(spots)))


def bollards(rng: np.random.Generator, palette: Palette, spots: Spots) -> Mesh:
    """Build iron mooring bollards, 0.55 m high, at the spots."""
    iron = palette.add(Material(texture="rust", variant=int(rng.integers(64)), tint=(0.75, 0.72, 0.7)))
    profile = [
        (0, 0),
        (0.26, 0),
        (0.26, 0.05),
        (0.15, 0.08),
        (0.13, 0.35),
        (0.22, 0.42),
        (0.22, 0.5),
        (0, 0.55),
    ]
    return _scatter(rng, [lathe(profile, iron, 20)], spots, np.ones(len(spots)))


def cones(rng: np.random.Generator, palette: Palette, spots: Spots) -> Mesh:
    """Build traffic cones, 0.55 m high and with a white band, at the spots."""
    orange = palette.add(Material(texture="plain", tint=(0.8, 0.2, 0.06), roughness=0.6))
    white = palette.add(Material(texture="plain", tint=(0.85, 0.85, 0.85), roughness=0.5))
    below = lathe([(0.14, 0.03), (0.1, 0.2)], orange, 16)
    band = lathe([(0.1, 0.2), (0.065, 0.35)], white, 16)
    above = lathe([(0.065, 0.35), (0.025, 0.55), (0, 0.55)], orange, 16)
    cone = join_meshes([boxes((0, 0, 0.015), (0.36, 0.36, 0.03), orange), below, band, above])
    return _scatter(rng, [cone], spots, np.ones(len(spots)))


def _scatter(
    rng: np.random.Generator, kinds: Sequence[Mesh], spots: Spots, scales: Float[np.ndarray, " n"]
) -> Mesh:
    """Put a random kind of object at each spot, scaled and randomly rotated about z."""
    which = rng.integers(len(kinds), size=len(spots))
    angle = rng.uniform(0, 2 * np.pi, len(spots))
    poses = np.tile(np.eye(4), (len(spots), 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(angle) * scales
    poses[:, 1, 0] = np.sin(angle) * scales
    poses[:, 0, 1] = -poses[:, 1, 0]
    poses[:, 2, 2] = scales
    poses[:, :3, 3] = spots
    return join_meshes([copies(kind, poses[which == k]) for k, kind in enumerate(kinds)])


def _widening_grid(extent_m: float, near_m: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the x and y coordinates of a grid, each [steps + 1, steps + 1].

    The grid is fine within near_m of the origin and coarser farther out.
    """
    end = np.arcsinh(extent_m / near_m)
    axis = near_m * np.sinh(np.linspace(-end, end, steps + 1))
    x, y = np.meshgrid(axis, axis)
    return x, y


def _map_texture_from_above(mesh: Mesh) -> Mesh:
    """Return the mesh with its texture projected from above."""
    return replace(mesh, uv_m=mesh.corners_m[..., :2].copy())


def _add_foliage(rng: np.random.Generator, palette: Palette) -> int:
    tint: Colour = [(1.1, 1.15, 0.9), (0.9, 1.05, 0.85), (1.25, 1.15, 0.85)][int(rng.integers(3))]
    return palette.add(
        Material(
            texture="leaves",
            variant=int(rng.integers(64)),
            tint=vary_colour(rng, tint),
            span_m=0.3,
            roughness=0.9,
            relief=1.0,
        )
    )


def _tree(rng: np.random.Generator, bark: int, leaves: int, spread: float) -> Mesh:
    """Build a broad tree of height 1, with a forked trunk and clumps of foliage."""
    fork = np.array([0, 0, 0.35])
    tips = rng.uniform((-0.2, -0.2, 0.6), (0.2, 0.2, 0.8), (4, 3))
    trunk = tubes([0, 0, -0.1], fork, [[0.04, 0.028]], bark, 7, capped=False)
    branches = tubes(fork, tips, [[0.02, 0.008]] * 4, bark, 4, capped=False)
    centres = np.concatenate([tips * [1, 1, 0.95], [[0, 0, 0.62]]])
    crown = _lumps(rng, centres, (spread * 0.6, spread * 0.6, 0.22), leaves)
    return join_meshes([trunk, branches, crown, _tufts(rng, crown, 70, 0.055)])


def _fir(rng: np.random.Generator, bark: int, leaves: int) -> Mesh:
    """Build a fir of height 1, with tiers of needles."""
    trunk = tubes([[0, 0, -0.1]], [[0, 0, 0.9]], np.array([[0.022, 0.005]]), bark, 6)
    skirts = []
    for z in np.linspace(0.15, 0.8, 6):
        radius = 0.24 * (1.05 - z) + 0.02
        skirt = lathe(
            [(radius * 0.3, z + 0.02), (radius, z), (radius * 0.35, z + 0.13), (0, z + 0.2)], leaves, 10
        )
        skirts.append(_perturb(rng, skirt, 0.16))
    return join_meshes([trunk, *skirts])


def _lumps(
    rng: np.random.Generator, centres_m: Spots, radii_m: Sequence[float] | np.ndarray, material: int
) -> Mesh:
    """Build uneven balls of foliage or stone."""
    radii = np.asarray(radii_m) * rng.uniform(0.8, 1.2, (len(centres_m), 1))
    return _perturb(rng, spheres(centres_m, radii, material, 1), 0.22)


def _tufts(rng: np.random.Generator, crown: Mesh, count: int, size_m: float) -> Mesh:
    """Build tufts, each a single triangle, that roughen the outline of a crown."""
    pick = rng.integers(len(crown.material), size=count)
    normals = crown.normals[pick].mean(1, keepdims=True)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    corners = crown.corners_m[pick].mean(1, keepdims=True) + rng.uniform(-1.4, 1.4, (count, 3, 3)) * size_m
    corners += rng.uniform(-0.2, 0.6, (count, 1, 1)) * size_m * normals
    tufts = facets(corners, int(crown.material[0]))
    turned = (tufts.normals[:, :1] * normals).sum(-1) < 0
    outwards = np.where(turned[..., None], tufts.corners_m[:, ::-1], tufts.corners_m)
    return replace(tufts, corners_m=outwards, normals=np.repeat(normals, 3, axis=1).astype(np.float32))


def _perturb(rng: np.random.Generator, mesh: Mesh, share: float) -> Mesh:
    """Displace the vertices randomly, in proportion to the size of the mesh, and roughen the normals."""
    corners = mesh.corners_m
    size = np.ptp(corners.reshape(-1, 3), axis=0).max() / 2
    # Coincident vertices move together, because the displacement depends on the position alone.
    waves = rng.normal(0, 9, (3, 3)) / size
    moved = corners + share * size * 0.5 * np.sin(corners @ waves + rng.uniform(0, 6, 3))
    flat = np.cross(moved[:, 1] - moved[:, 0], moved[:, 2] - moved[:, 0])
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
    normals = mesh.normals + flat[:, None]
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    return replace(mesh, corners_m=moved.astype(np.float32), normals=normals.astype(np.float32))


def _house(rng: np.random.Generator, palette: Palette) -> Mesh:
    """Build a house, 6 to 11 m long, with its ridge along x."""
    family = str(rng.choice(["brick", "plaster", "wood"]))
    tint = vary_colour(rng, (1.1, 1.04, 0.95) if family == "plaster" else (1.0, 0.96, 0.92))
    walls = palette.add(Material(texture=family, variant=int(rng.integers(64)), tint=tint, span_m=2.5))
    tiles = palette.add(
        Material(texture="tiles", variant=int(rng.integers(64)), tint=vary_colour(rng, (1.0, 0.96, 0.95)))
    )
    glass = palette.add(Material(texture="plain", tint=(0.08, 0.1, 0.12), roughness=0.08))
    white = palette.add(Material(texture="paint", tint=vary_colour(rng, (0.8, 0.8, 0.78)), roughness=0.6))
    length, width, eaves = rng.uniform(6, 11), rng.uniform(5, 7), rng.uniform(2.8, 5.5)
    rise = width / 2 * np.tan(np.radians(rng.uniform(30, 48)))
    return join_meshes(
        [
            _gabled_walls(length, width, eaves, rise, walls),
            _roof(length, width, eaves, rise, tiles),
            _openings((length, width, eaves), int(rng.integers(3, 5)), glass, white),
            boxes((length * 0.25, width * 0.15, eaves + rise), (0.6, 0.6, 1.8), walls),
        ]
    )


def _gabled_walls(length: float, width: float, eaves: float, rise: float, material: int) -> Mesh:
    outline = [
        (-width / 2, -0.6),
        (width / 2, -0.6),
        (width / 2, eaves),
        (0, eaves + rise),
        (-width / 2, eaves),
    ]
    upright = np.array([[0.0, 0, 1, -length / 2], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    return prism(np.array(outline), length, material).transform(upright)


def _roof(length: float, width: float, eaves: float, rise: float, material: int) -> Mesh:
    """Build a roof of two slabs that overhang the walls by 0.4 m."""
    slope = np.arctan2(rise, width / 2)
    across = width / 2 / np.cos(slope) + 0.4
    turns = np.stack([rotation((1, 0, 0), side * np.degrees(slope))[:3, :3] for side in (1, -1)])
    middle = np.array([0, -across / 2 * np.cos(slope), eaves + rise - across / 2 * np.sin(slope) + 0.09])
    return boxes([middle, middle * [1, -1, 1]], (length + 0.8, across + 0.1, 0.16), material, turns)


def _openings(size_m: tuple[float, float, float], columns: int, glass: int, frame: int) -> Mesh:
    """Build a door, and rows of windows on the long walls and the gables.

    size_m: length and width of the house, and height of the eaves.
    """
    length, width, eaves = size_m
    floors = np.arange(1.5, eaves - 0.6, 2.6)
    along = np.linspace(-length / 2 + 1.2, length / 2 - 1.2, columns)
    x, z, side = (v.ravel() for v in np.meshgrid(along, floors, [-1, 1]))
    y, z2, end = (v.ravel() for v in np.meshgrid([-width / 4, width / 4], floors, [-1, 1]))
    centres = np.concatenate(
        [np.stack([x, side * width / 2, z], -1), np.stack([end * length / 2, y, z2], -1)]
    )
    thin = np.concatenate([np.tile([1.0, 0.1, 1.2], (len(x), 1)), np.tile([0.1, 1.0, 1.2], (len(y), 1))])
    # To avoid z-fighting, panes protrude more than frames, and glazing bars protrude more than panes.
    frames = boxes(centres, thin + np.where(thin < 0.5, 0.0, 0.2), frame)
    panes = boxes(centres, np.where(thin < 0.5, 0.16, thin), glass)
    bars = boxes(centres, np.where(thin < 0.5, 0.22, [0.06, 0.06, 1.2]), frame)
    door = boxes((along[0] + 1.3, -width / 2, 1.0), (0.95, 0.18, 2.05), frame)
    return join_meshes([frames, panes, bars, door])


def _crate(wood: int, frame: int) -> Mesh:
    """Build a crate, 1 m in size, with battens along its edges."""
    ends = np.array([(a, b) for a in (-0.47, 0.47) for b in (0.03, 0.97)])
    along_x = boxes(np.insert(ends, 0, 0, axis=1), (1.02, 0.1, 0.1), frame)
    along_y = boxes(np.insert(ends, 1, 0, axis=1), (0.1, 1.02, 0.1), frame)
    upright = [(a, b, 0.5) for a in (-0.47, 0.47) for b in (-0.47, 0.47)]
    return join_meshes(
        [boxes((0, 0, 0.5), (0.96, 0.96, 0.96), wood), along_x, along_y, boxes(upright, (0.1, 0.1, 1), frame)]
    )


def _add_paint(rng: np.random.Generator, palette: Palette, family: str = "paint") -> int:
    tint: Colour = [(0.2, 0.3, 0.42), (0.5, 0.16, 0.12), (0.6, 0.5, 0.2), (0.22, 0.35, 0.25)][
        int(rng.integers(4))
    ]
    tint = tint if family == "paint" else (0.9, 0.9, 0.9)
    return palette.add(
        Material(texture=family, variant=int(rng.integers(64)), tint=vary_colour(rng, tint), roughness=0.5)
    )


def _scale_colour(colour: Colour, factor: float) -> Colour:
    return tuple(float(c * factor) for c in colour)  # type: ignore[return-value]


def vary_colour(rng: np.random.Generator, colour: Colour) -> Colour:
    """Vary the brightness and the temperature of a colour randomly, by small amounts."""
    red, green, blue = np.array(colour) * rng.uniform(0.85, 1.1) * rng.uniform(0.96, 1.04, 3)
    return float(red), float(green), float(blue)
