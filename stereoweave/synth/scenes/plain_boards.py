"""Scene `boards`: plain boards, tables and walls near the cameras, among textured objects.

The interior of a plain surface cannot be matched, so its disparity follows from the outlines alone. Real
rooms are full of such surfaces, which are often near the cameras and larger than training crops.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.furniture import FURNITURE, book_stack, picture, plant
from stereoweave.synth.props.interiors import draw_lamps, pendants, shell
from stereoweave.synth.props.primitives import boxes, rotation, tubes
from stereoweave.synth.props.random_materials import draw_material, draw_material_from, draw_muted_colour
from stereoweave.synth.props.solids import SOLIDS, PropStyle
from stereoweave.synth.stage import Palette, Stage
from stereoweave.synth.viewpoints import Orbit
from stereoweave.synth.world import Colour, Lamp, Material, Mesh, Sky, World, join_meshes

# The cameras look along y, so that the foreground can be placed in front of them.
_AHEAD_DEG, _SWING_DEG = 270.0, 6.0
# Half the width of the view at a distance of 1 m, for the longest focal length of
# `viewpoints.draw_focal_px`.
_HALF_VIEW = 0.38
# Gives most plain surfaces a disparity of 20 to 120 px.
_NEAREST_PX = (32.0, 130.0)
_BAR_M = 0.015
# Texture period at which a texel of the faint noise is larger than the visible surface.
_EVEN_SPAN_M = 200.0
# Without sensor noise the slightest shading would be matchable, unlike in photographs.
_NOISE_LEVELS = (0.5, 1.5)
# Number of materials of the objects; with the room's materials, they stay within a renderer's limit of 64.
_SURFACES = 16
# Objects for table tops; furniture such as chairs would look like toys on a table.
_SMALL = (*SOLIDS, book_stack, picture, plant)


@dataclass(frozen=True, kw_only=True)
class _Foreground:
    """Plain surfaces near the cameras, with places for objects on them.

    Attributes:
        plain: Mesh of the plain surfaces.
        orbit: Viewpoints around a point on the z axis.
        spots_m: [N, 4], places for small objects: x, y, z and size.
        end_m: The y coordinate at which the foreground ends; the room continues behind it.
    """

    plain: Mesh
    orbit: Orbit
    spots_m: Float[np.ndarray, "n 4"]
    end_m: float


def plain_boards(rng: np.random.Generator) -> Stage:
    """Build a room behind standing boards, a table top or a wall, all of them close to the cameras."""
    palette = Palette()
    foreground = (_standing_boards, _table_top, _wall)[rng.integers(3)](rng, palette)
    width_m, depth_m, height_m = rng.uniform([3.5, 1.5, 2.5], [6.5, 3.5, 3.4]).tolist()
    front_m = -foreground.orbit.distance_m[1] - rng.uniform(0.8, 1.5)
    size_m = np.array([width_m, foreground.end_m + depth_m - front_m, height_m])
    middle_m = np.array([rng.uniform(-0.1, 0.1) * width_m, front_m + size_m[1] / 2, 0])
    walls = shell(rng, palette, size_m, open_roof=False, open_side=None).translate(*middle_m.tolist())
    lamp_spots_m = middle_m + size_m * rng.uniform([-0.4, -0.4, 0.78], [0.4, 0.4, 0.85], (4, 3))
    lamps = draw_lamps(rng, lamp_spots_m[: rng.integers(2, 5)])
    spots_m = np.concatenate([foreground.spots_m, _floor_spots(rng, foreground, depth_m)])
    away_m = foreground.orbit.distance_m[0] + spots_m[:, 1]
    skins = [palette.add(draw_material(rng, away)) for away in rng.choice(away_m, _SURFACES).tolist()]
    things = [_thing(rng, skins, spot_m) for spot_m in spots_m]
    shades = pendants(rng, palette, lamp_spots_m[: len(lamps)], height_m)
    sky, exposure = _light(rng, lamps)
    mesh = join_meshes([foreground.plain.as_target(), walls, shades, *things])
    world = World(mesh=mesh, materials=tuple(palette.materials), sky=sky, lamps=lamps, exposure=exposure)
    return Stage(
        world=world, orbit=foreground.orbit, nearest_px=_NEAREST_PX, noise_levels=rng.uniform(*_NOISE_LEVELS)
    )


def _standing_boards(rng: np.random.Generator, palette: Palette) -> _Foreground:
    """Build one to three boards, partitions or cupboards, each with a vertical edge in the picture."""
    distance_m, eye_m = rng.uniform(1.2, 1.9), rng.uniform(0.9, 1.4)
    away_m = [rng.uniform(0.65, 1.0), *rng.uniform(1.0, 1.8, rng.integers(0, 3)).tolist()]
    side = rng.choice([-1, 1])
    parts = []
    for k, away in enumerate(away_m):
        width_m = away * rng.uniform(0.7, 1.4)
        # The boards behind leave a gap beside the first one, because no outline would be visible otherwise.
        edge_m = rng.uniform(*((-0.6, 0.4) if k == 0 else (0.65, 0.85))) * away * _HALF_VIEW
        top_m = eye_m + away * rng.uniform(0.05, 0.5)
        pose = rotation((0, 0, 1), rng.normal(0, 15))
        pose[:2, 3] = side * (-1) ** k * (edge_m + width_m / 2), away - distance_m
        parts.append(_board(rng, palette, width_m, top_m).transform(pose))
    orbit = _orbit(rng, distance_m, eye_m, elevation_deg=rng.uniform(-5, 8))
    return _Foreground(
        plain=join_meshes(parts),
        orbit=orbit,
        spots_m=np.zeros((0, 4)),
        end_m=max(max(away_m) - distance_m, 0.2),
    )


def _table_top(rng: np.random.Generator, palette: Palette) -> _Foreground:
    """Build a table larger than the picture, with places for objects and sometimes a board at its end."""
    distance_m, table_m, end_m = rng.uniform(0.8, 1.3), rng.uniform(0.65, 0.85), rng.uniform(0.15, 0.7)
    width_m, length_m = rng.uniform(1.6, 3.0), distance_m + end_m + 0.4
    top = boxes([[0, 0, -0.02]], [[width_m, length_m, 0.04]], palette.add(_plain(rng)))
    corners_m = np.array([[x, y, -0.03] for x in (-0.45, 0.45) for y in (-0.45, 0.45)])
    corners_m *= [width_m, length_m, 1]
    legs = tubes(corners_m, corners_m * [1, 1, 0] - [0, 0, table_m], 0.025, palette.add(_trim(rng)), 10)
    table = join_meshes([top, legs]).transform(rotation((0, 0, 1), rng.normal(0, 6)))
    parts = [table.translate(rng.uniform(-0.3, 0.3), end_m - length_m / 2, table_m)]
    if rng.random() < 0.5:
        screen = _board(rng, palette, rng.uniform(0.5, 1.4), rng.uniform(0.35, 0.8))
        screen = screen.transform(rotation((0, 0, 1), rng.normal(0, 12)))
        parts.append(screen.translate(rng.uniform(-0.5, 0.5), end_m - 0.15, table_m))
    count = int(rng.integers(6, 13))
    reach_m = np.linspace(-0.45 * distance_m, end_m - 0.25, count)
    spots_m = _spots(rng, reach_m, distance_m, table_m, (0.1, 0.35))
    orbit = _orbit(rng, distance_m, table_m + 0.05, elevation_deg=rng.uniform(16, 34))
    return _Foreground(plain=join_meshes(parts), orbit=orbit, spots_m=spots_m, end_m=end_m)


def _wall(rng: np.random.Generator, palette: Palette) -> _Foreground:
    """Build a wall, seen head-on or at an angle, and a sideboard with places for objects."""
    distance_m, eye_m = rng.uniform(1.1, 1.7), rng.uniform(0.95, 1.3)
    turned_deg = rng.choice([-1, 1]) * rng.uniform(0, 60)
    length_m, end_m = rng.uniform(0.9, 1.6) * distance_m, rng.uniform(-0.1, 0.3)
    wall = boxes([[0, 0.06, 1.25]], [[2 * length_m, 0.12, 2.5]], palette.add(_plain(rng)))
    side_m = np.array([rng.uniform(0.9, 1.6), rng.uniform(0.2, 0.4), eye_m - rng.uniform(0.15, 0.4)])
    low = boxes([side_m * [0, -0.5, 0.5]], [side_m], palette.add(_plain(rng)))
    parts = [wall, low]
    if rng.random() < 0.5:
        print_m = rng.uniform([0.2, 0.01, 0.15], [0.6, 0.03, 0.5])
        face = palette.add(draw_material_from(rng, ("photograph", "sign", "cloth"), distance_m))
        parts.append(boxes([[rng.uniform(-0.5, 0.5), -0.01, eye_m + 0.2]], [print_m], face))
    pose = rotation((0, 0, 1), turned_deg)
    pose[1, 3] = end_m
    count = int(rng.integers(2, 6))
    x = (np.arange(count) + rng.uniform(0.3, 0.7, count)) / count - 0.5
    feet_m = np.stack([x * side_m[0], np.full(count, -side_m[1] / 2), np.full(count, side_m[2])], -1)
    sizes_m = rng.uniform(0.4, 1.0, count) * min(side_m[1], side_m[0] / count)
    spots_m = np.column_stack([feet_m @ pose[:3, :3].T + pose[:3, 3], sizes_m])
    orbit = _orbit(rng, distance_m, eye_m, elevation_deg=rng.uniform(-4, 8))
    return _Foreground(plain=join_meshes(parts).transform(pose), orbit=orbit, spots_m=spots_m, end_m=end_m)


def _board(rng: np.random.Generator, palette: Palette, width_m: float, top_m: float) -> Mesh:
    """Build a board, partition or cupboard of height top_m, with its front at y = 0, sometimes on feet."""
    low_m = 0.0 if rng.random() < 0.6 else rng.uniform(0.05, 0.3) * top_m
    depth_m, tall_m = rng.choice([rng.uniform(0.01, 0.04), rng.uniform(0.15, 0.5)]), top_m - low_m
    middle_m, trim = low_m + tall_m / 2, palette.add(_trim(rng))
    parts = [boxes([[0, depth_m / 2, middle_m]], [[width_m, depth_m, tall_m]], palette.add(_plain(rng)))]
    if low_m:
        feet_m = np.array([[-0.4 * width_m, depth_m / 2, 0], [0.4 * width_m, depth_m / 2, 0]])
        parts.append(tubes(feet_m, feet_m + [0, 0, low_m], _BAR_M, trim, 8))
    if rng.random() < 0.4:
        bar_m = rng.uniform(0.01, 0.03)
        across = boxes([[0, 0, z] for z in (low_m, top_m)], [width_m + bar_m, 0.02, bar_m], trim)
        upright = boxes(
            [[x, 0, middle_m] for x in (-width_m / 2, width_m / 2)], [bar_m, 0.02, tall_m - bar_m], trim
        )
        parts += [across, upright]
    return join_meshes(parts)


def _orbit(rng: np.random.Generator, distance_m: float, aim_m: float, elevation_deg: float) -> Orbit:
    """Return a small arc of viewpoints around the point at height aim_m on the z axis."""
    turned_deg = _AHEAD_DEG + rng.normal(0, 4)
    return Orbit(
        centre_m=(0.0, 0.0, aim_m),
        distance_m=(0.95 * distance_m, distance_m),
        azimuth_deg=(turned_deg - _SWING_DEG / 2, turned_deg + _SWING_DEG / 2),
        elevation_deg=(elevation_deg, elevation_deg + 3),
        aim_m=0.08,
        floor_m=0.4,
    )


def _plain(rng: np.random.Generator) -> Material:
    """Draw a material of one muted colour; 30 % of such materials have faint noise and 25 % are glossy."""
    even = rng.random() < 0.7
    return Material(
        texture="plain",
        variant=int(rng.integers(1000)),
        tint=draw_muted_colour(rng, 0.3),
        span_m=_EVEN_SPAN_M if even else rng.uniform(2.0, 8.0),
        roughness=rng.uniform(0.25, 0.5) if rng.random() < 0.25 else rng.uniform(0.6, 1.0),
        relief=0.0 if even else rng.uniform(0.0, 0.1),
    )


def _trim(rng: np.random.Generator) -> Material:
    return draw_material_from(rng, ("wood", "steel", "paint", "plain"), 1.0)


def _spots(
    rng: np.random.Generator,
    along_m: Float[np.ndarray, " n"],
    distance_m: float,
    level_m: float,
    sizes: tuple[float, float],
) -> Float[np.ndarray, "n 4"]:
    """Draw one spot at each y, spread across the view; sizes are fractions of the distance to the cameras."""
    away_m = along_m + distance_m
    x = rng.permutation(np.linspace(-1.3, 1.3, len(along_m))) * _HALF_VIEW * away_m
    sizes_m = rng.uniform(*sizes, len(along_m)) * away_m
    return np.stack([x, along_m, np.full_like(x, level_m), sizes_m], -1)


def _floor_spots(
    rng: np.random.Generator, foreground: _Foreground, depth_m: float
) -> Float[np.ndarray, "n 4"]:
    """Draw places for 8 to 16 objects on the floor behind the foreground."""
    along_m = foreground.end_m + np.linspace(0.35, depth_m - 0.4, int(rng.integers(8, 17)))
    return _spots(rng, along_m, foreground.orbit.distance_m[0], 0.0, (0.25, 0.6))


def _thing(rng: np.random.Generator, skins: Sequence[int], spot_m: Float[np.ndarray, "4"]) -> Mesh:
    """Build a solid or a piece of furniture at a spot."""
    kinds = FURNITURE if spot_m[2] == 0 and rng.random() < 0.6 else _SMALL
    main, other = (skins[k] for k in rng.integers(len(skins), size=2))
    mesh = kinds[rng.integers(len(kinds))](rng, PropStyle(main=main, other=other, bar_m=_BAR_M))
    low, high = mesh.corners_m.min((0, 1)), mesh.corners_m.max((0, 1))
    scale = float(spot_m[3]) / float((high - low).max())
    pose = rotation((0, 0, 1), rng.uniform(0, 360))
    pose[:3, :3] *= scale
    pose[:3, 3] = spot_m[:3] - pose[:3, :3] @ np.array([*(low + high)[:2] / 2, low[2]])
    return replace(mesh.transform(pose), uv_m=mesh.uv_m * np.float32(scale))


def _light(rng: np.random.Generator, lamps: Sequence[Lamp]) -> tuple[Sky, float]:
    """Draw ambient light from the walls and the ceiling, without sun, and a suitable exposure."""
    ambient = rng.uniform(0.25, 0.6)
    tint = np.array([1.0, 0.97, 0.92]) * rng.uniform(0.96, 1.04, 3)

    def scale_ambient(share: float) -> Colour:
        red, green, blue = (ambient * share * tint).tolist()
        return red, green, blue

    sky = Sky(
        sun=(0.0, 0.0, 1.0),
        sun_light=(0.0, 0.0, 0.0),
        zenith=scale_ambient(1.0),
        horizon=scale_ambient(0.85),
        ground=scale_ambient(0.55),
    )
    lamp_light = sum(lamp.light[1] / (1.0 + lamp.position_m[2] ** 2) for lamp in lamps)
    return sky, float(1.3 * np.exp(rng.normal(0, 0.25)) / (ambient + lamp_light))
