"""Random plans of tugs, trawlers, coasters and patrol boats, with their gear. The bow is at +x."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stereoweave.synth.props import deck_gear
from stereoweave.synth.props.deckhouses import House, ShipMaterials
from stereoweave.synth.props.hulls import Hull
from stereoweave.synth.props.primitives import Point, tubes
from stereoweave.synth.world import Mesh, join_meshes

Range = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class ShipPlan:
    """Plan of a ship.

    Attributes:
        hull: shape of the hull.
        house: deckhouse.
        bridge: wheelhouse on the deckhouse.
        funnels: coordinates (x, y) of each funnel on the deckhouse.
        mast_m: x coordinate and height of the mast on the bridge.
        fenders: whether tyres hang along the sides.
        build_gear: function that builds the deck gear; its last argument lists the container materials.
    """

    hull: Hull
    house: House
    bridge: House
    funnels: tuple[tuple[float, float], ...]
    mast_m: tuple[float, float]
    fenders: bool
    build_gear: Callable[[np.random.Generator, "ShipPlan", ShipMaterials, tuple[int, ...]], Mesh]

    def on_deck(self, x: float, y: float = 0.0) -> Point:
        """Return the point on the deck at x and y."""
        return np.array([x, y, self.hull.deck_m(x)])


@dataclass(frozen=True, kw_only=True)
class _HullRanges:
    """Hull dimensions for one type of ship, as fixed values or ranges; see `Hull`."""

    length_m: Range
    beam_m: Range
    draft_m: float
    freeboard_m: Range
    sheer_aft_m: float
    sheer_forward_m: Range
    stern: Range | float
    rake_m: Range | float
    bulwark_m: float


_HULLS = {
    "tug": _HullRanges(
        length_m=(6.8, 7.4),
        beam_m=(2.6, 3.0),
        draft_m=0.9,
        freeboard_m=(0.6, 0.75),
        sheer_aft_m=0.12,
        sheer_forward_m=(0.5, 0.75),
        stern=0.88,
        rake_m=0.35,
        bulwark_m=0.3,
    ),
    "trawler": _HullRanges(
        length_m=(7.0, 7.8),
        beam_m=(2.2, 2.6),
        draft_m=0.9,
        freeboard_m=(0.65, 0.8),
        sheer_aft_m=0.25,
        sheer_forward_m=(0.7, 1.0),
        stern=(0.7, 0.85),
        rake_m=(0.5, 0.9),
        bulwark_m=0.3,
    ),
    "coaster": _HullRanges(
        length_m=(7.8, 8.4),
        beam_m=(1.9, 2.2),
        draft_m=0.9,
        freeboard_m=(0.55, 0.75),
        sheer_aft_m=0.2,
        sheer_forward_m=(0.4, 0.6),
        stern=0.8,
        rake_m=(0.4, 0.7),
        bulwark_m=0.1,
    ),
    "patrol boat": _HullRanges(
        length_m=(7.6, 8.2),
        beam_m=(1.8, 2.1),
        draft_m=0.7,
        freeboard_m=(0.6, 0.75),
        sheer_aft_m=0.0,
        sheer_forward_m=(0.4, 0.6),
        stern=0.9,
        rake_m=(0.9, 1.2),
        bulwark_m=0.06,
    ),
}


def _draw_hull(rng: np.random.Generator, ranges: _HullRanges) -> Hull:
    def draw(size: Range | float) -> float:
        return rng.uniform(*size) if isinstance(size, tuple) else size

    return Hull(
        length_m=draw(ranges.length_m),
        beam_m=draw(ranges.beam_m),
        draft_m=ranges.draft_m,
        freeboard_m=draw(ranges.freeboard_m),
        sheer_m=(ranges.sheer_aft_m, draw(ranges.sheer_forward_m)),
        stern=draw(ranges.stern),
        rake_m=draw(ranges.rake_m),
        bulwark_m=ranges.bulwark_m,
    )


def tug(rng: np.random.Generator) -> ShipPlan:
    """Draw the plan of a short, broad tug, low aft, with tyres all round, a towing winch and a gantry."""
    hull = _draw_hull(rng, _HULLS["tug"])
    high = rng.uniform(0.8, 0.95)
    house = House(
        x_m=(-0.7, 1.9),
        width_m=rng.uniform(1.5, 1.75),
        z_m=(hull.deck_m(0.0) - 0.05, 0.45 + high),
        lean_m=(0, 0.25, 0.04),
    )
    bridge = House(x_m=(0.2, 1.45), width_m=1.3, z_m=(0.49 + high, 1.25 + high), lean_m=(-0.05, -0.16, -0.06))
    chimneys = ((-0.3, 0.48), (-0.3, -0.48)) if rng.random() < 0.6 else ((-0.25, 0.0),)
    return ShipPlan(
        hull=hull,
        house=house,
        bridge=bridge,
        funnels=chimneys,
        mast_m=(0.5, rng.uniform(1.2, 1.6)),
        fenders=True,
        build_gear=_towing_gear,
    )


def trawler(rng: np.random.Generator) -> ShipPlan:
    """Draw the plan of a trawler with a high bow, a derrick on a mast, a gantry aft, a winch and nets."""
    hull = _draw_hull(rng, _HULLS["trawler"])
    at = rng.uniform(-0.2, 0.2)
    house = House(
        x_m=(at, at + 1.9),
        width_m=rng.uniform(1.3, 1.5),
        z_m=(hull.deck_m(at) - 0.05, 1.45),
        lean_m=(0, 0.12, 0.03),
    )
    bridge = House(x_m=(at + 0.4, at + 1.7), width_m=1.25, z_m=(1.49, 2.25), lean_m=(0.0, -0.12, -0.03))
    return ShipPlan(
        hull=hull,
        house=house,
        bridge=bridge,
        funnels=((at + 0.05, 0.42),),
        mast_m=(at + 0.8, rng.uniform(1.1, 1.4)),
        fenders=bool(rng.random() < 0.3),
        build_gear=_fishing_gear,
    )


def coaster(rng: np.random.Generator) -> ShipPlan:
    """Draw the plan of a long, low coaster with its deckhouse aft, behind hatches and often containers."""
    hull = _draw_hull(rng, _HULLS["coaster"])
    house = House(
        x_m=(-3.4, -1.95), width_m=1.45, z_m=(hull.deck_m(-1.9) - 0.05, 1.75), lean_m=(0, 0.0, 0.02)
    )
    bridge = House(x_m=(-3.1, -1.9), width_m=1.75, z_m=(1.79, 2.45), lean_m=(0.0, -0.08, -0.02))
    return ShipPlan(
        hull=hull,
        house=house,
        bridge=bridge,
        funnels=((-3.35, 0.0),),
        mast_m=(-2.6, rng.uniform(0.8, 1.1)),
        fenders=False,
        build_gear=_cargo,
    )


def patrol_boat(rng: np.random.Generator) -> ShipPlan:
    """Draw the plan of a slender patrol boat with sloping walls and, aft, an inflatable boat and a crane."""
    hull = _draw_hull(rng, _HULLS["patrol boat"])
    house = House(x_m=(-1.5, 1.7), width_m=1.3, z_m=(hull.deck_m(0.0) - 0.1, 1.35), lean_m=(0.15, 0.7, 0.1))
    bridge = House(x_m=(-0.5, 0.95), width_m=1.15, z_m=(1.39, 2.0), lean_m=(0.1, 0.35, 0.12))
    return ShipPlan(
        hull=hull,
        house=house,
        bridge=bridge,
        funnels=(),
        mast_m=(-0.1, rng.uniform(1.0, 1.4)),
        fenders=False,
        build_gear=_rescue_gear,
    )


def _towing_gear(
    rng: np.random.Generator, plan: ShipPlan, materials: ShipMaterials, colours: tuple[int, ...]
) -> Mesh:
    aft = -plan.hull.length_m / 2
    return join_meshes(
        [
            deck_gear.winch(plan.on_deck(aft + 2.0), 0.9, materials, materials.rope),
            deck_gear.gantry(plan.on_deck(aft + 1.0), 1.3, 0.75, materials),
            deck_gear.coil(plan.on_deck(aft + 0.7, 0.5), materials),
            deck_gear.rafts(
                np.array([[0.0, side * 0.45, plan.house.z_m[1] + 0.05] for side in (1, -1)]), materials
            )
            if len(plan.funnels) == 1
            else deck_gear.coil(plan.on_deck(aft + 0.8, -0.6), materials),
        ]
    )


def _fishing_gear(
    rng: np.random.Generator, plan: ShipPlan, materials: ShipMaterials, colours: tuple[int, ...]
) -> Mesh:
    aft = -plan.hull.length_m / 2
    foot = np.array([plan.house.x_m[0] - 0.12, 0, plan.hull.deck_m(0.0)])
    top = foot + [0, 0, rng.uniform(2.9, 3.3)]
    swing = rng.uniform(-0.4, 0.4)
    tip = foot + np.array([-rng.uniform(1.8, 2.3), swing, rng.uniform(2.2, 2.7)])
    return join_meshes(
        [
            tubes(foot, top, 0.055, materials.trim, 14),
            deck_gear.derrick(foot + [-0.06, 0, 0.6], tip, top, materials),
            deck_gear.gantry(
                plan.on_deck(aft + 0.45), 0.7 * plan.hull.beam_m, rng.uniform(1.4, 1.8), materials
            ),
            deck_gear.winch(plan.on_deck(aft + 1.1), 1.2, materials, materials.rope),
            deck_gear.nets(rng, plan.on_deck(aft + 2.3, rng.uniform(-0.2, 0.2)), (1.1, 1.3), materials),
            deck_gear.coil(plan.on_deck(plan.house.x_m[1] + 0.4, 0.3), materials),
        ]
    )


def _cargo(
    rng: np.random.Generator, plan: ShipPlan, materials: ShipMaterials, colours: tuple[int, ...]
) -> Mesh:
    deck = plan.hull.deck_m(0.0)
    hold = (-1.5, 2.4)
    pieces = [deck_gear.hatches(hold, 1.3, deck, materials)]
    if rng.random() < 0.6:
        x, y = (v.ravel() for v in np.meshgrid([-0.7, 0.85], [-0.325, 0.325]))
        spots = np.stack([x, y, np.full(4, deck + 0.33)], -1)
        high = spots[rng.random(4) < 0.6] + [0, 0, 0.67]
        stack = np.concatenate([spots, high])
        pieces.append(deck_gear.containers(stack[rng.permutation(len(stack))], colours))
    foot = np.array([hold[1] + 0.3, 0, deck])
    top = foot + [0, 0, rng.uniform(2.0, 2.6)]
    tip = foot + np.array([-rng.uniform(1.6, 2.4), rng.uniform(-0.5, 0.5), rng.uniform(1.7, 2.1)])
    pieces += [
        tubes(foot, top, 0.06, materials.trim, 14),
        deck_gear.derrick(foot + [-0.06, 0, 0.5], tip, top, materials),
    ]
    pieces.append(deck_gear.coil(plan.on_deck(3.0, 0.2), materials))
    return join_meshes(pieces)


def _rescue_gear(
    rng: np.random.Generator, plan: ShipPlan, materials: ShipMaterials, colours: tuple[int, ...]
) -> Mesh:
    aft = -plan.hull.length_m / 2
    foot = plan.on_deck(aft + 2.15, 0.45)
    top = foot + [0, 0, 1.1]
    tip = foot + np.array([-1.0, -0.4, 1.35])
    monitor = np.array([plan.house.x_m[1] - 0.95, 0.0, plan.house.z_m[1] + 0.05])
    return join_meshes(
        [
            deck_gear.boat(plan.on_deck(aft + 1.2), 1.7, materials),
            tubes(foot, top, 0.06, materials.trim, 14),
            deck_gear.derrick(top - [0, 0, 0.2], tip, top, materials),
            deck_gear.rafts(
                np.array([[-1.05, side * 0.42, plan.house.z_m[1] + 0.05] for side in (1, -1)]), materials
            ),
            tubes(monitor, monitor + [0, 0, 0.3], 0.035, materials.trim, 12),
            tubes(
                monitor + [-0.1, 0, 0.26],
                monitor + [0.4, 0, 0.42],
                np.array([[0.04, 0.025]]),
                materials.trim,
                12,
            ),
        ]
    )


TRADES: dict[str, Callable[[np.random.Generator], ShipPlan]] = {
    "tug": tug,
    "trawler": trawler,
    "coaster": coaster,
    "patrol boat": patrol_boat,
}
