"""Interiors with a floor, walls, a ceiling, lamps and objects on the walls."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.furniture import shelf
from stereoweave.synth.props.primitives import boxes, lathe, sheet, spheres, tubes
from stereoweave.synth.props.random_materials import (
    draw_broad_material,
    draw_material,
    draw_material_from,
    draw_muted_colour,
)
from stereoweave.synth.props.solids import PropStyle
from stereoweave.synth.stage import Palette
from stereoweave.synth.world import Colour, Lamp, Material, Mesh, Sky, join_meshes

Corner = tuple[float, float, float]
Hanging = Callable[[np.random.Generator, Palette, float, float, int], Mesh]

_FLOORS = ("wood", "tiles", "concrete", "stone", "cloth", "photograph", "plain")
_WALLS = ("plaster", "plain", "photograph", "brick", "concrete", "cloth", "wood", "tiles", "paint")
_CEILINGS = ("plaster", "plain", "wood", "concrete")


def shell(
    rng: np.random.Generator,
    palette: Palette,
    size_m: Float[np.ndarray, "3"],
    *,
    open_roof: bool,
    open_side: int | None,
) -> Mesh:
    """Build a room around the z axis, with its floor at z = 0 and objects on its walls.

    open_side: index of the wall to omit, or None to keep all four; 0 is the wall at the largest x, and the
        others follow counter-clockwise.
    """
    x, y, height_m = (float(v) for v in size_m)
    distance_m = 0.6 * max(x, y)
    floor = palette.add(draw_broad_material(rng, _FLOORS, distance_m))
    parts = [_panel(rng, (-x / 2, -y / 2, 0), (x, 0, 0), (0, y, 0), floor)]
    if not open_roof:
        ceiling = palette.add(draw_broad_material(rng, _CEILINGS, distance_m))
        parts.append(_panel(rng, (-x / 2, y / 2, height_m), (x, 0, 0), (0, -y, 0), ceiling))
    common = palette.add(draw_broad_material(rng, _WALLS, distance_m))
    trim = palette.add(draw_material_from(rng, ("wood", "paint", "plain"), distance_m))
    for side in range(4):
        if side == open_side:
            continue
        wall = common if rng.random() < 0.6 else palette.add(draw_broad_material(rng, _WALLS, distance_m))
        length_m, away_m = (y, x / 2) if side % 2 == 0 else (x, y / 2)
        panel = _panel(rng, (-length_m / 2, 0, 0), (0, 0, height_m), (length_m, 0, 0), wall)
        skirting = boxes([[0, 0.01, 0.05]], [[length_m, 0.05, 0.1]], trim)
        on_it = _hang_on_wall(rng, palette, length_m, height_m, trim)
        parts.append(join_meshes([panel, skirting, *on_it]).transform(_wall_pose(side, away_m)))
    return join_meshes(parts)


def pendants(
    rng: np.random.Generator, palette: Palette, spots_m: Float[np.ndarray, "n 3"], ceiling_m: float
) -> Mesh:
    """Build pendant lamps at the spots: shades with glowing bulbs, on cords from the ceiling."""
    shade = palette.add(Material(texture="plain", tint=draw_muted_colour(rng, 0.4), roughness=0.5))
    bulb = palette.add(Material(texture="plain", tint=(1.0, 0.95, 0.85), glow=4.0))
    wide_m, high_m = rng.uniform(0.1, 0.25), rng.uniform(0.1, 0.25)
    outside, inside = [[1.0, -0.3], [0.7, 0.3], [0.12, 1.0]], [[0.08, 1.0], [0.65, 0.27], [0.95, -0.3]]
    body = lathe(np.array(outside + inside) * [wide_m, high_m], shade, 36)
    cords = tubes(spots_m + [0, 0, high_m], spots_m * [1, 1, 0] + [0, 0, ceiling_m], 0.006, shade)
    return join_meshes([*(body.translate(*spot) for spot in spots_m), cords, spheres(spots_m, 0.05, bulb)])


def draw_lamps(rng: np.random.Generator, spots_m: Float[np.ndarray, "n 3"]) -> tuple[Lamp, ...]:
    """Draw random lamps for a room, all of one warm or cold colour but of different strengths."""
    warm = rng.uniform(0, 1)
    colour = np.array([1.0, 0.95 - 0.2 * warm, 0.92 - 0.5 * warm])
    strengths = np.exp(rng.normal(0, 0.6, len(spots_m)))
    lights = (4 * strengths[:, None] * colour).tolist()
    return tuple(
        Lamp(position_m=(x, y, z), light=(red, green, blue))
        for (x, y, z), (red, green, blue) in zip(spots_m.tolist(), lights, strict=True)
    )


def draw_lamp_spots(
    rng: np.random.Generator, size_m: Float[np.ndarray, "3"], eyes_m: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "n 3"]:
    """Draw random positions of one to four lamps in the upper part of a room, away from the cameras."""
    low_m, high_m = size_m * [-0.4, -0.4, 0.68], size_m * [0.4, 0.4, 0.85]
    spots_m = rng.uniform(low_m, high_m, (40, 3))
    clear_m = np.linalg.norm(spots_m[:, None] - eyes_m, axis=2).min(1)
    return spots_m[np.argsort(clear_m < 1.0, kind="stable")[: rng.integers(1, 5)]]


def indoor_light(rng: np.random.Generator, sky: Sky, lamps: Sequence[Lamp]) -> tuple[Sky, float]:
    """Draw random ambient light for a room, in the form of a sunless sky, and the exposure of the images."""
    ambient = rng.uniform(0.15, 0.6)
    warm = np.array([1.0, 0.95, 0.87])

    def scale_ambient(share: float) -> Colour:
        red, green, blue = (ambient * share * warm * rng.uniform(0.95, 1.05, 3)).tolist()
        return red, green, blue

    room_light = Sky(
        sun=sky.sun,
        sun_light=(0.0, 0.0, 0.0),
        zenith=scale_ambient(1.0),
        horizon=scale_ambient(0.8),
        ground=scale_ambient(0.5),
    )
    lamp_light = sum(lamp.light[1] / (1.0 + np.sum(np.square(lamp.position_m))) for lamp in lamps)
    return room_light, float(1.1 * np.exp(rng.normal(0, 0.3)) / (ambient + lamp_light))


def _panel(rng: np.random.Generator, origin: Corner, along: Corner, up: Corner, material: int) -> Mesh:
    """Build a slightly uneven surface whose normal is `along` x `up`.

    The surface extends slightly beyond its corners, so adjacent surfaces leave no gap.
    """
    share = np.linspace(-0.01, 1.01, 29)
    u, v = np.meshgrid(share, share)
    normal = np.cross(along, up) / np.linalg.norm(np.cross(along, up))
    waves = [rng.normal(0, 0.002) * np.sin(u * rng.uniform(3, 25) + v * rng.uniform(3, 25)) for _ in range(4)]
    bumps = np.sum(waves, axis=0)[..., None] * normal
    return sheet(
        np.array(origin) + u[..., None] * np.array(along) + v[..., None] * np.array(up) + bumps, material
    )


def _wall_pose(side: int, away_m: float) -> Float[np.ndarray, "4 4"]:
    """Return the pose of a wall in the room.

    In the coordinates of the wall, x runs along the wall, y into the room and z up.
    """
    angle = side * np.pi / 2
    inwards = -np.array([np.cos(angle), np.sin(angle), 0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([np.cross(inwards, [0, 0, 1]), inwards, [0, 0, 1]], -1)
    pose[:3, 3] = -away_m * inwards
    return pose


def _hang_on_wall(
    rng: np.random.Generator, palette: Palette, length_m: float, height_m: float, trim: int
) -> list[Mesh]:
    """Build objects on one wall, each in its own section of the wall."""
    count = int(rng.integers(1, min(int(length_m / 1.4), 3) + 1))
    stretch_m = length_m / count
    kinds: list[Hanging] = [_window, _door, _poster, _shelves, _radiator, _curtain]
    hung = []
    for k in range(count):
        kind = kinds[rng.choice(len(kinds), p=[0.2, 0.12, 0.28, 0.2, 0.1, 0.1])]
        mesh = kind(rng, palette, min(stretch_m * 0.8, 1.8), height_m, trim)
        hung.append(mesh.translate(x=(k + 0.5) * stretch_m - length_m / 2))
    return hung


def _frame(width_m: float, low_m: float, high_m: float, bar_m: float, trim: int) -> Mesh:
    """Build four bars around an opening."""
    middle_m, tall_m = (low_m + high_m) / 2, high_m - low_m
    level = boxes([[0, 0.02, z] for z in (low_m, high_m)], [width_m + bar_m, 0.08, bar_m], trim)
    upright = boxes(
        [[x, 0.02, middle_m] for x in (-width_m / 2, width_m / 2)], [bar_m, 0.08, tall_m - bar_m], trim
    )
    return join_meshes([level, upright])


def _window(rng: np.random.Generator, palette: Palette, width_m: float, height_m: float, trim: int) -> Mesh:
    """Build a window with glazing bars, a sill and daylight behind its panes."""
    low_m, high_m = 0.85, min(height_m - 0.25, 2.2)
    outside = Material(
        texture=str(rng.choice(["photograph", "sky", "leaves"])),
        variant=int(rng.integers(1000)),
        span_m=rng.uniform(1.5, 3),
        roughness=0.2,
        glow=rng.uniform(0.4, 1.5),
    )
    pane = boxes([[0, 0.015, (low_m + high_m) / 2]], [width_m, 0.02, high_m - low_m], palette.add(outside))
    bars = boxes(
        [
            [x, 0.03, (low_m + high_m) / 2]
            for x in np.linspace(-0.5, 0.5, int(rng.integers(2, 5)) + 1)[1:-1] * width_m
        ],
        [0.04, 0.05, high_m - low_m - 0.06],
        trim,
    )
    sill = boxes([[0, 0.09, low_m - 0.05]], [width_m + 0.2, 0.22, 0.04], trim)
    return join_meshes([pane, bars, sill, _frame(width_m, low_m, high_m, 0.07, trim)])


def _door(rng: np.random.Generator, palette: Palette, width_m: float, height_m: float, trim: int) -> Mesh:
    """Build a panelled door with a handle."""
    width_m, high_m = min(width_m, 0.95), min(height_m - 0.15, 2.05)
    leaf = palette.add(draw_material_from(rng, ("wood", "paint", "plain"), 4.0))
    panels = boxes([[0, 0.04, z * high_m] for z in (0.27, 0.72)], [0.7 * width_m, 0.03, 0.36 * high_m], leaf)
    handle = tubes([[0.4 * width_m, 0.1, 1.02]], [[0.27 * width_m, 0.1, 1.02]], 0.012, trim, 8)
    return join_meshes(
        [
            boxes([[0, 0.02, high_m / 2]], [width_m, 0.04, high_m], leaf),
            panels,
            handle,
            _frame(width_m, 0.0, high_m, 0.08, trim),
        ]
    )


def _poster(rng: np.random.Generator, palette: Palette, width_m: float, height_m: float, trim: int) -> Mesh:
    """Build a framed poster or picture at eye level."""
    width_m, tall_m = width_m * rng.uniform(0.4, 0.9), rng.uniform(0.4, 1.2)
    low_m = min(1.55, 0.55 * height_m) - tall_m / 2
    face = palette.add(draw_material_from(rng, ("photograph", "photograph", "sign", "cloth"), tall_m * 3))
    print_ = boxes([[0, 0.015, low_m + tall_m / 2]], [width_m, 0.02, tall_m], face)
    return join_meshes([print_, _frame(width_m, low_m, low_m + tall_m, rng.uniform(0.02, 0.06), trim)])


def _shelves(rng: np.random.Generator, palette: Palette, width_m: float, height_m: float, trim: int) -> Mesh:
    """Build a bookcase against the wall."""
    skin = PropStyle(main=trim, other=palette.add(draw_material(rng, 4.0)), bar_m=0.01)
    pose = np.diag([width_m / 0.75, 1.2, min(0.8 * height_m, rng.uniform(0.8, 2.2)), 1.0])
    return shelf(rng, skin).transform(pose).translate(y=0.2)


def _radiator(rng: np.random.Generator, palette: Palette, width_m: float, height_m: float, trim: int) -> Mesh:
    """Build a radiator of vertical ribs between two pipes."""
    x = np.linspace(-0.45, 0.45, int(rng.integers(8, 24))) * width_m
    ribs = tubes(
        [[at, 0.09, 0.16] for at in x], [[at, 0.09, 0.75] for at in x], 0.35 * (x[1] - x[0]), trim, 10
    )
    pipes = tubes(
        [[x[0], 0.09, z] for z in (0.18, 0.72)], [[x[-1], 0.09, z] for z in (0.18, 0.72)], 0.03, trim, 10
    )
    return join_meshes([ribs, pipes])


def _curtain(rng: np.random.Generator, palette: Palette, width_m: float, height_m: float, trim: int) -> Mesh:
    """Build a curtain hanging in folds from a rod."""
    cloth = palette.add(draw_material_from(rng, ("cloth", "plain", "photograph"), 4.0))
    high_m = min(height_m - 0.1, 2.4)
    x, z = np.meshgrid(np.linspace(-0.5, 0.5, 60) * width_m, np.linspace(0.05, high_m, 14))
    folds = 0.04 * np.sin(x * rng.uniform(25, 45) + 0.6 * np.sin(2 * z)) * (1.3 - 0.3 * z / high_m)
    rod = tubes([[-0.55 * width_m, 0.1, high_m]], [[0.55 * width_m, 0.1, high_m]], 0.015, trim, 8)
    return join_meshes([sheet(np.stack([-x, 0.1 + folds, z], -1), cloth), rod])
