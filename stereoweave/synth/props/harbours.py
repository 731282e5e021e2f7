"""Surroundings of ships: a harbour quay, or the open sea with a distant coast."""

import numpy as np

from stereoweave.synth.props import surroundings
from stereoweave.synth.props.hulls import Hull
from stereoweave.synth.props.lattice import cables, galvanised_steel, ladder, painted_steel
from stereoweave.synth.props.primitives import Points, boxes, copies, lathe, rotation, translation, tubes
from stereoweave.synth.props.surroundings import draw_spots, vary_colour
from stereoweave.synth.stage import Palette
from stereoweave.synth.world import Material, Mesh, join_meshes

_BOLLARDS_M = np.array([-5.2, -1.0, 1.2, 6.0, -14.0, 14.0])


def open_water(rng: np.random.Generator, palette: Palette) -> Mesh:
    """Build the open sea with buoys and a distant ring of wooded hills."""
    pieces = [
        surroundings.sea(rng, palette),
        surroundings.hills(rng, palette, distance_m=rng.uniform(110, 170)),
    ]
    pieces.append(_buoys(rng, palette, draw_spots(rng, 5, 16, 60)))
    return join_meshes(pieces)


def _buoys(rng: np.random.Generator, palette: Palette, spots: Points) -> Mesh:
    """Build red and green buoys that lean in the current."""
    kinds = []
    for colour in ((0.5, 0.08, 0.06), (0.08, 0.3, 0.14)):
        paint = palette.add(painted_steel(rng, colour))
        body = lathe(
            [(0, -0.3), (0.6, -0.3), (0.65, 0.25), (0.2, 0.4), (0.12, 1.5), (0.3, 1.5), (0.02, 2.1)],
            paint,
            20,
        )
        kinds.append(body.transform(rotation((1, 0.4, 0), rng.uniform(-9, 9))))
    return join_meshes(
        [copies(kind, np.stack([translation(*spot) for spot in spots[k::2]])) for k, kind in enumerate(kinds)]
    )


def harbour(rng: np.random.Generator, palette: Palette, hull: Hull) -> Mesh:
    """Build a quay along the ship's starboard side, with mooring ropes, goods and buildings."""
    edge_m, top_m = -hull.beam_m / 2 - rng.uniform(0.3, 0.45), rng.uniform(0.7, 1.1)
    paving = palette.add(
        Material(
            texture=str(rng.choice(["concrete", "asphalt", "stone"])),
            variant=int(rng.integers(64)),
            tint=vary_colour(rng, (0.85, 0.83, 0.8)),
            span_m=6.0,
        )
    )
    wall = palette.add(
        Material(
            texture=str(rng.choice(["stone", "concrete"])),
            variant=int(rng.integers(64)),
            tint=(0.8, 0.8, 0.78),
            span_m=3.0,
        )
    )
    rope = palette.add(Material(texture="cloth", variant=1, tint=(1.5, 1.4, 1.2), span_m=0.3))
    iron = palette.add(galvanised_steel(rng))
    quay = boxes(
        [(0, edge_m - 60, top_m - 3), (0, edge_m - 0.2, top_m - 3.0)], [(240, 120, 6), (240, 0.5, 6.04)], wall
    )
    top = boxes((0, edge_m - 60.5, top_m - 0.1), (240, 119.8, 0.26), paving)
    ladders = [
        ladder((x, edge_m + 0.12, -1.0), (x, edge_m + 0.12, top_m + 0.1), (1, 0, 0), 0.4, iron)
        for x in (-5.5, 5.8)
    ]
    x = np.arange(-30, 31, 3.0)
    piles = tubes(
        np.stack([x, 0 * x + edge_m + 0.12, 0 * x - 2], -1),
        np.stack([x, 0 * x + edge_m + 0.12, 0 * x + top_m + 0.15], -1),
        0.12,
        palette.add(Material(texture="wood", tint=(0.5, 0.45, 0.4))),
        10,
    )
    things = _on_quay(rng, palette, edge_m).translate(z=top_m)
    return join_meshes(
        [
            surroundings.sea(rng, palette),
            quay,
            top,
            *ladders,
            piles,
            things,
            _moorings(hull, edge_m, top_m, rope),
        ]
    )


def _moorings(hull: Hull, edge_m: float, top_m: float, rope: int) -> Mesh:
    """Build mooring ropes from the bow and stern to the bollards on the quay."""
    share = np.array([0.08, 0.12, 0.85, 0.9])
    starts = hull.side_m(share, hull.edge_m(share) - 0.05, -1)
    x = _BOLLARDS_M[[0, 1, 2, 3]]
    ends = np.stack([x, np.full(4, edge_m - 0.7), np.full(4, top_m + 0.3)], -1)
    return cables(starts, ends, 0.022, rope, sag_m=0.12)


def _on_quay(rng: np.random.Generator, palette: Palette, edge_m: float) -> Mesh:
    """Build bollards, stacked goods, lamp posts, warehouses, trees and hills."""
    beside = np.stack([_BOLLARDS_M, np.full(6, edge_m - 0.7), np.zeros(6)], -1)
    spots = np.stack([rng.uniform(-12, 12, 36), edge_m - rng.uniform(1.8, 8, 36), np.zeros(36)], -1)
    kinds = (surroundings.crates, surroundings.barrels, surroundings.pallets, surroundings.cones)
    things = [
        kind(rng, palette, spots[9 * k : 9 * k + int(rng.integers(4, 10))]) for k, kind in enumerate(kinds)
    ]
    house_x = np.arange(-44, 45, 14.0)
    rows = np.stack([house_x + rng.normal(0, 1.5, 7), edge_m - rng.uniform(14, 24, 7), np.zeros(7)], -1)
    trees = draw_spots(rng, 24, 28, 80)
    lamp_x = np.arange(-22, 23, 11.0)
    lamps = np.stack([lamp_x, np.full(5, edge_m - 1.8), np.zeros(5)], -1)
    steel = palette.add(galvanised_steel(rng))
    return join_meshes(
        [
            surroundings.bollards(rng, palette, beside),
            *things,
            surroundings.houses(rng, palette, rows),
            surroundings.trees(rng, palette, trees[trees[:, 1] < edge_m - 26]),
            surroundings.hills(rng, palette, distance_m=120).translate(z=-1),
            tubes(lamps, lamps + [0, 0, 4.6], 0.05, steel, 8),
            tubes(lamps + [0, 0, 4.6], lamps + [0, 0.9, 4.7], 0.035, steel, 6),
        ]
    )
