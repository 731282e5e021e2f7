"""Scene `ship`: a tug, trawler, coaster or patrol boat at sea or at a quay. The bow is at +x."""

from dataclasses import replace

import numpy as np

from stereoweave.synth.props import deck_gear
from stereoweave.synth.props.deckhouses import (
    ShipMaterials,
    door,
    funnel,
    lifebuoys,
    ship_mast,
    stays,
    tyres,
    windows,
)
from stereoweave.synth.props.harbours import harbour, open_water
from stereoweave.synth.props.hulls import Hull
from stereoweave.synth.props.lattice import galvanised_steel, ladder, painted_steel, railing
from stereoweave.synth.props.primitives import Point, lathe, rotation, sheet, tubes
from stereoweave.synth.props.ships import TRADES, ShipPlan
from stereoweave.synth.props.surroundings import daylight, vary_colour
from stereoweave.synth.stage import Palette, Stage, outdoor_stage
from stereoweave.synth.viewpoints import Orbit
from stereoweave.synth.world import Colour, Material, Mesh, join_meshes


def ship(rng: np.random.Generator) -> Stage:
    """Build a stage with a ship 7 to 8.5 m long, most or all of which is in the picture."""
    palette = Palette()
    plan = TRADES[str(rng.choice(list(TRADES)))](rng)
    heel = rotation((1, 0, 0), rng.normal(0, 0.8)) @ rotation((0, 1, 0), rng.normal(0, 0.6))
    vessel = _build_ship(rng, palette, plan).transform(heel)
    moored = rng.random() < 0.5
    around = harbour(rng, palette, plan.hull) if moored else open_water(rng, palette)
    light = daylight(rng)
    mesh = join_meshes([vessel.as_target(), around])
    orbit = Orbit(
        centre_m=(0.0, 0.0, 0.8),
        distance_m=(6.6, 9.6),
        azimuth_deg=(22.0, 158.0) if moored else (0.0, 360.0),
        elevation_deg=(2.0, 24.0),
        aim_m=0.6,
        floor_m=0.8,
    )
    return outdoor_stage(mesh, palette, light, orbit)


# Colours of hull, stripe, bottom, house and trim, as used by real fleets.
_LIVERIES: tuple[tuple[Colour, Colour, Colour, Colour, Colour], ...] = (
    ((0.05, 0.06, 0.07), (0.9, 0.9, 0.87), (0.42, 0.1, 0.07), (0.9, 0.88, 0.82), (0.6, 0.3, 0.08)),
    ((0.06, 0.13, 0.28), (0.9, 0.9, 0.87), (0.4, 0.11, 0.08), (0.95, 0.95, 0.93), (0.62, 0.12, 0.08)),
    ((0.4, 0.07, 0.05), (0.9, 0.9, 0.87), (0.08, 0.09, 0.1), (0.95, 0.94, 0.9), (0.08, 0.1, 0.12)),
    ((0.09, 0.15, 0.12), (0.85, 0.8, 0.65), (0.4, 0.11, 0.08), (0.9, 0.87, 0.78), (0.6, 0.5, 0.28)),
    ((0.42, 0.45, 0.47), (0.1, 0.1, 0.11), (0.35, 0.1, 0.08), (0.5, 0.53, 0.55), (0.3, 0.33, 0.35)),
    ((0.95, 0.95, 0.93), (0.1, 0.2, 0.4), (0.1, 0.22, 0.36), (0.97, 0.96, 0.93), (0.1, 0.25, 0.45)),
    ((0.3, 0.4, 0.46), (0.9, 0.9, 0.87), (0.4, 0.11, 0.08), (0.92, 0.9, 0.85), (0.7, 0.45, 0.15)),
)


def _build_ship(rng: np.random.Generator, palette: Palette, plan: ShipPlan) -> Mesh:
    """Build the ship with its waterline at z = 0."""
    side, stripe, bottom, walls, trim = _LIVERIES[rng.integers(len(_LIVERIES))]
    coats = [
        palette.add(replace(painted_steel(rng, colour), span_m=rng.uniform(3, 5)))
        for colour in (bottom, stripe, side)
    ]
    materials = _draw_materials(rng, palette, walls, trim)
    sign = palette.add(Material(texture="sign", variant=1, span_m=1.0, roughness=0.6))
    cloth = palette.add(Material(texture="cloth", variant=0, tint=vary_colour(rng, trim), span_m=0.5))
    boxes = tuple(
        palette.add(painted_steel(rng, colour))
        for colour in ((0.35, 0.12, 0.08), (0.12, 0.2, 0.35), (0.5, 0.48, 0.42))
    )
    hull = plan.hull
    pieces = [
        hull.skin(*coats),
        hull.deck(materials.roof, materials.house, materials.trim),
        _houses(rng, plan, materials),
        _forward(plan, materials),
        _name(hull, sign),
        plan.build_gear(rng, plan, materials, boxes),
        deck_gear.flag(rng, plan.on_deck(-hull.length_m / 2 + 0.12), 1.0, materials, cloth),
    ]
    if plan.fenders:
        pieces.append(_fenders(hull, materials))
    if hull.bulwark_m < 0.2:
        pieces.append(_rails(hull, materials))
    return join_meshes(pieces)


def _draw_materials(rng: np.random.Generator, palette: Palette, walls: Colour, trim: Colour) -> ShipMaterials:
    decks: tuple[Colour, ...] = ((0.14, 0.21, 0.17), (0.3, 0.14, 0.1), (0.33, 0.34, 0.35))
    return ShipMaterials(
        house=palette.add(painted_steel(rng, walls)),
        roof=palette.add(painted_steel(rng, decks[int(rng.integers(3))], 0.8)),
        trim=palette.add(painted_steel(rng, trim)),
        white=palette.add(painted_steel(rng, (0.95, 0.95, 0.92))),
        dark=palette.add(Material(texture="plain", tint=(0.05, 0.05, 0.055), roughness=0.7)),
        glass=palette.add(Material(texture="plain", tint=(0.05, 0.07, 0.08), roughness=0.06)),
        steel=palette.add(galvanised_steel(rng)),
        orange=palette.add(Material(texture="plain", tint=(0.75, 0.2, 0.05), roughness=0.6)),
        rope=palette.add(
            Material(
                texture="cloth",
                variant=int(rng.integers(3)),
                tint=vary_colour(
                    rng, [(0.6, 0.9, 0.75), (0.65, 0.75, 1.0), (1.6, 1.4, 1.1)][int(rng.integers(3))]
                ),
                span_m=0.3,
                relief=0.8,
            )
        ),
    )


def _houses(rng: np.random.Generator, plan: ShipPlan, materials: ShipMaterials) -> Mesh:
    """Build the deckhouse and the bridge with their fittings."""
    house, bridge = plan.house, plan.bridge
    starboard, front, port, back = house.walls_m()
    pieces = [house.mesh(materials.house, materials.roof), bridge.mesh(materials.house, materials.roof, 0.09)]
    pieces += [
        windows(wall, max(int(house.x_m[1] - house.x_m[0]) * 2, 3), (0.58, 0.8), materials, 0.55)
        for wall in (starboard, port)
    ]
    pieces += [windows(front, 3, (0.55, 0.8), materials, 0.5), door(back, rng.uniform(0.3, 0.7), materials)]
    for wall, count in zip(bridge.walls_m(), (3, 5, 3, 3), strict=True):
        pieces.append(windows(wall, count, (0.44, 0.82), materials, 0.3))
    top = house.z_m[1] + 0.05
    pieces += [
        funnel(np.array([x, y, top - 0.05]), (0.5, 0.34 if y else 0.5, 1.0), materials)
        for x, y in plan.funnels
    ]
    foot = np.array([plan.mast_m[0], 0, bridge.z_m[1] + 0.04])
    pieces += [
        ship_mast(rng, foot, plan.mast_m[1], materials),
        _rigging(plan, foot, materials),
        _roof_rails(plan, materials),
    ]
    half = house.width_m / 2
    at = np.array(
        [
            [house.x_m[0] + 0.35, side * (half + 0.03), house.z_m[0] + 0.62 * (top - house.z_m[0])]
            for side in (1, -1)
        ]
    )
    pieces.append(lifebuoys(at, np.array([[0, 1.0, 0], [0, -1.0, 0]]), materials))
    return join_meshes(pieces)


def _rigging(plan: ShipPlan, foot: Point, materials: ShipMaterials) -> Mesh:
    """Build stays from the mast to bow and stern, and a searchlight on the bridge."""
    top = foot + [-0.05 * plan.mast_m[1], 0, 0.92 * plan.mast_m[1]]
    bow, aft = plan.hull.length_m / 2, -plan.hull.length_m / 2
    ends = np.array(
        [plan.on_deck(bow + 0.2) + [0, 0, plan.hull.bulwark_m], plan.on_deck(aft + 0.1) + [0, 0, 0.9]]
    )
    lamp = lathe([(0.05, 0), (0.09, 0.05), (0.09, 0.12), (0, 0.12)], materials.white, 14).transform(
        rotation((0, 1, 0), 85)
    )
    light = np.array([plan.bridge.x_m[1] - 0.15, 0.3, plan.bridge.z_m[1] + 0.17])
    post = tubes(light - [0, 0, 0.15], light, 0.02, materials.white)
    return join_meshes([stays(np.stack([top, top]), ends, materials), lamp.translate(*light), post])


def _roof_rails(plan: ShipPlan, materials: ShipMaterials) -> Mesh:
    """Build a railing around the after part of the deckhouse roof, and a ladder to the bridge roof."""
    _, top = plan.house.corners_m(-0.05)
    top = top + [0, 0, 0.05]
    ahead = (plan.bridge.x_m[0] - plan.house.x_m[0]) / (plan.house.x_m[1] - plan.house.x_m[0])
    ahead = float(np.clip(ahead, 0.12, 1)) + 0.1
    path = np.stack([top[0] + ahead * (top[1] - top[0]), top[0], top[3], top[3] + ahead * (top[2] - top[3])])
    back = plan.bridge.x_m[0]
    foot, head = (back - 0.14, -0.3, plan.bridge.z_m[0]), (back - 0.1, -0.3, plan.bridge.z_m[1] + 0.2)
    return join_meshes(
        [
            railing(path, 0.38, 0.4, 0.012, materials.white, 3),
            ladder(foot, head, (0, 1, 0), 0.26, materials.white),
        ]
    )


def _forward(plan: ShipPlan, materials: ShipMaterials) -> Mesh:
    """Build the windlass, bitts, vents and anchors on the forecastle."""
    hull = plan.hull
    bow = hull.length_m / 2
    ends = np.array([[0.14], [0.76]])
    inboard = hull.side_m(ends, hull.edge_m(ends) - hull.bulwark_m, np.array([1, -1])) * [1, 0.76, 1]
    anchors = []
    for side in (1.0, -1.0):
        at = hull.side_m(0.93, hull.edge_m(0.93) - 0.32, side)
        anchors.append(deck_gear.anchor(at, side, materials))
    windlass = deck_gear.winch(np.zeros(3), 0.6, materials, materials.rope).transform(
        np.diag([0.6, 0.6, 0.6, 1])
    )
    return join_meshes(
        [
            windlass.translate(*plan.on_deck(bow - 0.75)),
            deck_gear.bitts(inboard.reshape(-1, 3), materials),
            deck_gear.vents(np.stack([plan.on_deck(bow - 1.15, side * 0.22) for side in (1, -1)]), materials),
            *anchors,
        ]
    )


def _name(hull: Hull, sign: int) -> Mesh:
    """Build name plates on both sides of the bow and on the stern."""
    plates = []
    for side in (1, -1):
        plates.append(hull.patch((48, 54), (3, 5), side, sign))
    z = hull.edge_m(0.0) - np.array([0.4, 0.12])
    at = hull.side_m(np.zeros(2), z, 0.0) - [0.03, 0, 0]
    plates.append(sheet(np.stack([at + [0, y, 0] for y in (0.45, -0.45)], 1), sign))
    return join_meshes(plates)


def _fenders(hull: Hull, materials: ShipMaterials) -> Mesh:
    """Build tyre fenders along both sides."""
    share = np.linspace(0.06, 0.76, 9)
    hung = []
    for side in (1, -1):
        at, ahead = (hull.side_m(s, hull.edge_m(s) - 0.2, side) for s in (share, share + 0.01))
        hung.append(tyres(at + [0, side * 0.05, 0], (ahead - at) * [1, 1, 0], materials))
    return join_meshes(hung)


def _rails(hull: Hull, materials: ShipMaterials) -> Mesh:
    """Build railings along both sides and the stern."""
    share = np.linspace(0.985, 0.0, 14)
    port, starboard = (hull.side_m(share, hull.edge_m(share), side) * [1, 0.97, 1] for side in (1, -1))
    return railing(np.concatenate([port, starboard[::-1]]), 0.36, 0.6, 0.011, materials.white, 3)
