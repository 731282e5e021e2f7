"""Scene `refinery`: columns, tanks, pressure vessels and stacks on both sides of a pipe rack."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from stereoweave.synth.props.lattice import aviation_paints, galvanised_steel, painted_steel, railing
from stereoweave.synth.props.pipework import pipes, rack
from stereoweave.synth.props.primitives import boxes, lathe, rotation, translation
from stereoweave.synth.props.refinery_units import (
    RefineryMaterials,
    RefineryUnit,
    ball_tank,
    chimney,
    column,
    drum_tank,
    flare,
    pressure_vessels,
)
from stereoweave.synth.props.surroundings import (
    barrels,
    daylight,
    draw_spots,
    hills,
    houses,
    pallets,
    terrain,
    trees,
)
from stereoweave.synth.stage import Palette, Stage, outdoor_stage
from stereoweave.synth.viewpoints import Orbit
from stereoweave.synth.world import Material, Mesh, join_meshes

UNITS: dict[str, Callable[[np.random.Generator, RefineryMaterials], RefineryUnit]] = {
    "column": column,
    "ball tank": ball_tank,
    "drum tank": drum_tank,
    "vessels": pressure_vessels,
    "chimney": chimney,
    "flare": flare,
}
# Least and greatest number of units of each kind, enough for people to recognise a refinery.
_COUNTS = {
    "column": (3, 3),
    "ball tank": (1, 2),
    "drum tank": (2, 3),
    "vessels": (2, 2),
    "chimney": (1, 1),
    "flare": (1, 1),
}
_PLOTS_X_M = (-2.7, -0.9, 0.9, 2.7)
_PLOTS_Y_M = (-2.75, -1.4, 1.4, 2.75)
_HALF_RACK_M = 3.3
_YARD_M = 13.5  # half of the yard's side
# Props of the surroundings are built at real size; this factor shrinks them to the refinery's scale.
_SMALL = np.diag([0.3, 0.3, 0.3, 1.0])


def refinery(rng: np.random.Generator) -> Stage:
    """Build a stage with a refinery of 10 to 12 units, seen from any side."""
    palette = Palette()
    materials = _draw_materials(rng, palette)
    rusty = Material(texture="rust", variant=int(rng.integers(64)), span_m=0.8)
    paints = [painted_steel(rng, colour) for colour in ((0.5, 0.4, 0.1), (0.2, 0.3, 0.24))]
    lines = (*materials.shells[:4], *(palette.add(material) for material in (rusty, *paints)))
    plant = [*_units(rng, materials, lines), _rack(rng, materials, lines), *_yard(rng, palette, materials)]
    corners = _YARD_M * np.array([(x, y, 0.0) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))])
    around = [
        _ground(rng, palette),
        railing(corners, 0.28, 1.2, 0.012, materials.rail, rails=3),
        _tank_farm(rng, materials),
        trees(rng, palette, draw_spots(rng, 7, 17.0, 60.0), (1.0, 2.6)),
        houses(rng, palette, draw_spots(rng, 6, 20.0, 50.0) / 0.3).transform(_SMALL),
        hills(rng, palette, distance_m=rng.uniform(70, 120)),
    ]
    light = daylight(rng)
    mesh = join_meshes([*(part.as_target() for part in plant), *around])
    orbit = Orbit(
        centre_m=(0.0, 0.0, 1.5), distance_m=(7.5, 11.0), elevation_deg=(-4.0, 24.0), aim_m=0.7, floor_m=0.6
    )
    return outdoor_stage(mesh, palette, light, orbit)


def _draw_materials(rng: np.random.Generator, palette: Palette) -> RefineryMaterials:
    red, white = aviation_paints(rng)
    bare = Material(
        texture="steel",
        variant=int(rng.integers(64)),
        tint=(1.3, 1.3, 1.32),
        span_m=0.7,
        roughness=0.4,
        metal=0.6,
    )
    shells = (
        galvanised_steel(rng),
        bare,
        painted_steel(rng, (0.75, 0.75, 0.72)),
        painted_steel(rng, (0.5, 0.53, 0.52)),
        painted_steel(rng, (0.55, 0.5, 0.4)),
    )
    structure = painted_steel(rng, [(0.25, 0.27, 0.28), (0.3, 0.16, 0.1), (0.2, 0.28, 0.33)][rng.integers(3)])
    rails = painted_steel(rng, (0.62, 0.45, 0.06) if rng.random() < 0.6 else (0.6, 0.6, 0.58))
    return RefineryMaterials(
        shells=tuple(palette.add(shell) for shell in shells),
        steel=palette.add(structure),
        rail=palette.add(rails),
        red=palette.add(red),
        white=palette.add(white),
        concrete=palette.add(
            Material(texture="concrete", variant=int(rng.integers(64)), tint=(0.8, 0.79, 0.76), span_m=1.2)
        ),
        sign=palette.add(Material(texture="sign", variant=int(rng.integers(64)), span_m=0.5)),
        flame=palette.add(Material(texture="plain", tint=(1.0, 0.5, 0.12), glow=6.0)),
    )


def _units(rng: np.random.Generator, materials: RefineryMaterials, lines: tuple[int, ...]) -> list[Mesh]:
    """Build the units on their plots, and pipes from their nozzles to the rack."""
    plots = iter(np.array([(x, y) for x in _PLOTS_X_M for y in _PLOTS_Y_M])[rng.permutation(16)])
    meshes: list[Mesh] = []
    routes: dict[int, list[Float[np.ndarray, "_ 3"]]] = {}
    for name, counts in _COUNTS.items():
        count = int(rng.integers(counts[0], counts[1] + 1))
        # Two units may be identical, because building units takes most of the time.
        kinds = [UNITS[name](rng, materials) for _ in range((count + 1) // 2)]
        for k in range(count):
            x, y = next(plots)
            pose = translation(x, y) @ rotation((0, 0, 1), 90.0 * int(rng.integers(4)))
            unit = kinds[k % len(kinds)]
            meshes.append(unit.mesh.transform(pose))
            for nozzle in unit.nozzles_m @ pose[:3, :3].T + pose[:3, 3]:
                routes.setdefault(int(rng.choice(lines[:4])), []).append(_route(rng, nozzle, (x, y)))
    radii_m = {coat: rng.choice([0.02, 0.028, 0.036], len(paths)).tolist() for coat, paths in routes.items()}
    return [*meshes, *(pipes(paths, radii_m[coat], coat) for coat, paths in routes.items())]


def _route(
    rng: np.random.Generator, start_m: Float[np.ndarray, "3"], plot_m: tuple[float, float]
) -> Float[np.ndarray, "_ 3"]:
    """Return a pipe's route from a nozzle to a lane between the plots, along the lane, and into the rack."""
    x, y, z = start_m
    lane_x, side = plot_m[0] + rng.choice([-1, 1]) * rng.uniform(0.7, 0.88), np.sign(plot_m[1])
    high_m, into_m = float(rng.choice([0.17, 0.51, 0.63])), float(rng.choice([0.8, 1.16]))
    near_y, rack_y = side * 0.62, side * rng.uniform(0.1, 0.45)
    return np.array(
        [(x, y, z), (lane_x, y, z), (lane_x, y, high_m), (lane_x, near_y, high_m), (lane_x, near_y, into_m)]
        + [(lane_x, rack_y, into_m)]
    )


def _rack(rng: np.random.Generator, materials: RefineryMaterials, lines: tuple[int, ...]) -> Mesh:
    levels_m = (0.72, 1.08) if rng.random() < 0.6 else (0.72, 1.08, 1.42)
    return rack(rng, _HALF_RACK_M, levels_m, lines, materials)


def _yard(rng: np.random.Generator, palette: Palette, materials: RefineryMaterials) -> list[Mesh]:
    """Build the yard: a slab under the plant, signs, drums and pallets."""
    slab = boxes([[0, 0, 0.0]], [[8.4, 8.0, 0.03]], materials.concrete)
    spots = np.column_stack(
        [rng.uniform(-3.6, 3.6, 6), rng.choice([-1, 1], 6) * rng.uniform(3.5, 3.9, 6), np.zeros(6)]
    )
    boards = [boxes([spot + [0, 0, 0.28]], [[0.34, 0.015, 0.22]], materials.sign) for spot in spots[:3]]
    legs = boxes(spots[:3] + [0, 0, 0.12], [[0.03, 0.012, 0.26]], materials.rail)
    drums = barrels(rng, palette, _cluster(rng, 6) / 0.3).transform(_SMALL)
    stacks = pallets(rng, palette, _cluster(rng, 4) / 0.3).transform(_SMALL)
    return [slab, *boards, legs, drums, stacks]


def _ground(rng: np.random.Generator, palette: Palette) -> Mesh:
    """Build a paved yard in open land."""
    family = str(rng.choice(["concrete", "asphalt", "gravel"]))
    paving = Material(
        texture=family, variant=int(rng.integers(64)), tint=(0.9, 0.88, 0.85), span_m=1.6, roughness=0.95
    )
    yard = boxes([[0, 0, -0.2]], [[2.02 * _YARD_M, 2.02 * _YARD_M, 0.4]], palette.add(paving))
    land = str(rng.choice(["grass", "grass", "soil"]))
    return join_meshes(
        [yard, terrain(rng, palette, land, extent_m=110.0, level_m=-0.1, bumps_m=0.8, flat_radius_m=20.0)]
    )


def _tank_farm(rng: np.random.Generator, materials: RefineryMaterials) -> Mesh:
    """Build large, distant tanks on one side."""
    spots = draw_spots(rng, 24, 18.0, 42.0)
    spots = spots[np.argsort(-spots @ [np.cos(way := rng.uniform(0, 6)), np.sin(way), 0])[:7]]
    profile = np.array(
        [[0, 0], [2.2, 0], [2.2, 0.7], [2.24, 0.72], [2.2, 0.74], [2.2, 1.5], [0.05, 1.8], [0, 1.8]]
    )
    tanks = [lathe(profile * rng.uniform([0.7, 0.9], [1.1, 1.5]), materials.shell(rng), 24) for _ in range(2)]
    return join_meshes(tanks[k % 2].translate(x, y, -0.1) for k, (x, y, _) in enumerate(spots))


def _cluster(rng: np.random.Generator, count: int) -> Float[np.ndarray, "n 3"]:
    """Draw adjacent spots at the edge of the plant."""
    middle = np.array([rng.choice([-1, 1]) * 3.85, rng.uniform(-3.4, 3.4), 0.015])
    grid = np.stack(np.meshgrid(np.arange(3) - 1, np.arange(3) - 1), -1).reshape(-1, 2)[:count]
    return middle + np.pad(0.26 * grid + rng.normal(0, 0.02, grid.shape), ((0, 0), (0, 1)))
