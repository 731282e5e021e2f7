"""Sterns of large ships, with a hull, a skeg or bracket, a shaft and a rudder. Aft is +x."""

from dataclasses import dataclass

import numpy as np

from stereoweave.synth.props.hulls import Hull
from stereoweave.synth.props.primitives import Points, boxes, lathe, loft, rotation, sweep, translation, tubes
from stereoweave.synth.props.propellers import Propeller, turn_aft
from stereoweave.synth.props.surroundings import vary_colour
from stereoweave.synth.stage import Palette
from stereoweave.synth.world import Colour, Material, Mesh, join_meshes

_BOTTOMS: tuple[Colour, ...] = ((0.4, 0.1, 0.07), (0.33, 0.12, 0.08), (0.1, 0.1, 0.11), (0.12, 0.2, 0.32))
_SIDES: tuple[Colour, ...] = ((0.05, 0.06, 0.07), (0.07, 0.13, 0.25), (0.4, 0.42, 0.44), (0.09, 0.2, 0.15))
_LENGTH_M = 34.0


@dataclass(frozen=True, kw_only=True)
class Stern:
    """Stern of a ship with its propeller at the origin.

    Attributes:
        mesh: hull with fittings, without the propeller.
        keel_m: height of the keel.
        hull: the hull in its own coordinates, with the bow at +x and the waterline at z = 0.
        end_m: x coordinate of the hull's aft end.
        water_m: height of the waterline.
    """

    mesh: Mesh
    keel_m: float
    hull: Hull
    end_m: float
    water_m: float

    def side_m(self, x: np.ndarray, z: np.ndarray, side: float) -> Points:
        """Return points on the hull's skin near x and z.

        side: 1 for the side at +y, -1 for the side at -y.
        """
        share = (self.end_m - x) / _LENGTH_M
        at = self.hull.side_m(share, z - self.water_m, -side)
        return np.stack([self.end_m - _LENGTH_M / 2 - at[:, 0], -at[:, 1], z], -1)


def stern(rng: np.random.Generator, palette: Palette, propeller: Propeller) -> Stern:
    """Build a hull above the propeller, with a skeg or a bracket and, sometimes, a rudder."""
    bottom = palette.add(_coat(rng, _BOTTOMS))
    stripe = palette.add(_coat(rng, ((0.75, 0.75, 0.72), (0.6, 0.5, 0.15))))
    topside = palette.add(_coat(rng, _SIDES))
    zinc = palette.add(Material(texture="steel", tint=(1.5, 1.5, 1.45), roughness=0.6, metal=0.3))
    clear_m = propeller.radius_m + rng.uniform(0.25, 0.45)
    end_m, water_m, keel_m = rng.uniform(3.0, 4.0), clear_m + 0.35, -propeller.radius_m - 0.25
    draft_m = water_m - keel_m
    hull = Hull(
        length_m=_LENGTH_M,
        beam_m=rng.uniform(8, 10),
        draft_m=draft_m,
        freeboard_m=rng.uniform(2.5, 4),
        sheer_m=(0.3, 1.0),
        stern=rng.uniform(0.7, 0.9),
        rise=(clear_m - keel_m) / draft_m,
        rise_to=0.45,
        rake_m=2.0,
    )
    skin = hull.skin(bottom, stripe, topside, stripe_m=0.25)
    pieces = [skin.transform(translation(end_m - _LENGTH_M / 2, 0, water_m) @ rotation((0, 0, 1), 180))]
    sole = Stern(mesh=pieces[0], keel_m=keel_m, hull=hull, end_m=end_m, water_m=water_m)
    steel = palette.add(_shaft(rng))
    pieces.append(
        _skeg(sole, propeller, bottom) if rng.random() < 0.65 else _bracket(propeller, clear_m, bottom, steel)
    )
    pieces.append(_collar(propeller, steel))
    if rng.random() < 0.4:
        pieces.append(_rudder(rng, propeller, clear_m, bottom, zinc))
    pieces.append(_anodes(sole, zinc))
    return Stern(mesh=join_meshes(pieces), keel_m=keel_m, hull=hull, end_m=end_m, water_m=water_m)


def _coat(rng: np.random.Generator, colours: tuple[Colour, ...]) -> Material:
    return Material(
        texture="paint",
        variant=int(rng.integers(64)),
        tint=vary_colour(rng, colours[int(rng.integers(len(colours)))]),
        span_m=rng.uniform(2, 4),
        roughness=rng.uniform(0.5, 0.8),
        relief=0.3,
    )


def _shaft(rng: np.random.Generator) -> Material:
    return Material(
        texture="steel", variant=int(rng.integers(3)), tint=(1.0, 1.0, 1.0), roughness=0.35, metal=0.9
    )


def _skeg(sole: Stern, propeller: Propeller, material: int) -> Mesh:
    """Build the skeg below the hull, with a boss around the shaft."""
    after_m = -propeller.hub_half_m - 0.25
    away = np.linspace(0, 1, 30)[::-1, None] ** 1.5
    x = after_m - 13 * away
    top_m = sole.water_m + sole.hull.keel_m((sole.end_m - x) / _LENGTH_M) + 0.5
    foot_m = sole.keel_m + (0.55 * -sole.keel_m) * np.exp(-away / 0.06)
    angle = np.linspace(0, 2 * np.pi, 56, endpoint=False)[None]
    up = (1 + np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** 0.8) / 2
    z = foot_m + (top_m - foot_m) * up
    boss = propeller.hub_m * np.exp(-(np.abs(z / (1.1 * propeller.hub_m)) ** 2.5)) * (1 - away) ** 3
    width = 0.1 + 1.6 * away**0.8 + boss
    y = width * np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** 0.5
    return loft(np.stack([x + 0 * y, y, z], -1), material)


def _bracket(propeller: Propeller, clear_m: float, material: int, steel: int) -> Mesh:
    """Build a shaft bracket with two struts, and the exposed shaft."""
    r, front_m = propeller.hub_m, -propeller.hub_half_m - 0.05
    profile = [
        (0, -1.5),
        (0.8 * r, -1.5),
        (1.0 * r, -1.2),
        (1.05 * r, -0.6),
        (0.98 * r, -0.1),
        (0.6 * r, -0.1),
    ]
    barrel = turn_aft(lathe(profile, material, 40)).translate(x=front_m)
    shaft = tubes([front_m, 0, 0], [front_m - 11, 0, 0.4], 0.45 * r, steel, sides=24)
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    foil = np.stack([0.42 * np.cos(angle), 0.09 * np.sin(angle)], -1)
    struts = []
    for side in (1, -1):
        foot, head = (front_m - 0.8, side * 0.3 * r, 0.0), (front_m - 1.1, side * 1.7, clear_m + 1.2)
        rings = [end + np.column_stack([foil, 0 * angle]) for end in np.linspace(foot, head, 4)]
        struts.append(loft(np.stack(rings), material))
    return join_meshes([barrel, shaft, *struts])


def _collar(propeller: Propeller, material: int) -> Mesh:
    """Build the rope guard between the hub and the bearing."""
    r = 0.95 * propeller.hub_m
    ring = [(0.5 * r, 0), (1.05 * r, 0), (1.05 * r, 0.3), (0.9 * r, 0.33), (0.5 * r, 0.33)]
    return turn_aft(lathe(ring, material, 40)).translate(x=-propeller.hub_half_m - 0.35)


def _rudder(rng: np.random.Generator, propeller: Propeller, clear_m: float, material: int, zinc: int) -> Mesh:
    """Build a rudder and its stock, turned by a random angle."""
    chord_m = rng.uniform(0.95, 1.3)
    foot_m, head_m = -rng.uniform(0.45, 0.75) * propeller.radius_m, clear_m - 0.25
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    x = chord_m * (0.25 + 0.5 * np.cos(angle))
    thick = 0.11 * chord_m * np.sin(angle) * (1.1 - 0.75 * np.cos(angle))
    levels = np.linspace(0, 1, 12)[:, None]
    wide = 0.7 + 0.35 * levels
    blade = loft(
        np.stack([x * wide, thick * wide, foot_m + (head_m - foot_m) * levels + 0 * x], -1), material
    )
    stock = tubes([0, 0, head_m - 0.1], [0, 0, head_m + 1.5], 0.14, material, sides=16)
    horn = boxes([-0.05, 0, head_m + 0.5], [0.6 * chord_m, 0.3, 0.85], material)
    at = [[0.25, side * 0.085, foot_m + h] for side in (1, -1) for h in (0.5, 1.4)]
    fixed = boxes(at, (0.3, 0.06, 0.1), zinc)
    sole = sweep([[-0.17 * chord_m, 0, foot_m], [0.52 * chord_m, 0, foot_m]], 0.025, material)
    axis_m = propeller.hub_half_m + 0.1 + 1.15 * propeller.hub_m + 0.4 + 0.25 * chord_m
    put = rotation((0, 0, 1), rng.uniform(-32, 32))
    return join_meshes([blade, stock, horn, fixed, sole]).transform(put).translate(x=axis_m)


def _anodes(sole: Stern, zinc: int) -> Mesh:
    """Build a row of zinc anodes on each side, slightly above the propeller."""
    x = np.linspace(-8, 1, 5)
    level = np.full(5, sole.water_m - 0.28)
    at = np.concatenate([sole.side_m(x, level, side) for side in (1, -1)])
    return boxes(at, (0.4, 0.12, 0.14), zinc)
