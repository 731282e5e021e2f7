"""Tables close to the cameras, with upright boards and a wall close behind them.

The cameras are on the +x side, their view is centred above the origin, and the floor is at z = 0.
"""

from dataclasses import dataclass

import numpy as np

from stereoweave.synth.props.primitives import boxes, rotation
from stereoweave.synth.props.random_materials import draw_broad_material
from stereoweave.synth.stage import Palette
from stereoweave.synth.world import Mesh, join_meshes

_TOPS = ("wood", "concrete", "stone", "cloth", "tiles", "photograph", "paint")
_BACKDROPS = ("plaster", "brick", "photograph", "concrete", "cloth", "wood", "paint")
_BOARDS = ("photograph", "sign", "wood", "cloth", "paint")
_THICK_M = 0.04


@dataclass(frozen=True, kw_only=True)
class TableTop:
    """Dimensions of a table.

    Attributes:
        distance_m: distance from the cameras to the centre of the view.
        height_m: height of the table's surface.
        behind_m: distance from the centre of the view to the wall, where the table ends.
        before_m: distance from the centre of the view to the front edge of the table.
        width_m: width of the table across the view.
    """

    distance_m: float
    height_m: float
    behind_m: float
    before_m: float
    width_m: float


def draw_table_top(rng: np.random.Generator) -> TableTop:
    """Draw random dimensions for a table that usually fills the width of the image."""
    distance_m = rng.uniform(1.5, 2.3)
    return TableTop(
        distance_m=distance_m,
        height_m=rng.uniform(0.5, 0.9),
        behind_m=distance_m * rng.uniform(0.15, 0.75),
        before_m=distance_m * rng.uniform(0.2, 0.7),
        width_m=distance_m * rng.uniform(0.7, 2.0),
    )


def table_top(rng: np.random.Generator, palette: Palette, sizes: TableTop) -> Mesh:
    """Build a table with up to three boards and, in nine cases out of ten, one or two walls behind it."""
    parts = [_table(rng, palette, sizes), *_boards(rng, palette, sizes)]
    if rng.random() < 0.9:
        parts.append(_backdrop(rng, palette, sizes))
    return join_meshes(parts)


def _table(rng: np.random.Generator, palette: Palette, sizes: TableTop) -> Mesh:
    """Build a table: a slab on a narrower plinth."""
    material = palette.add(draw_broad_material(rng, _TOPS, sizes.distance_m))
    length_m = sizes.behind_m + sizes.before_m
    x = (sizes.before_m - sizes.behind_m) / 2
    under_m = sizes.height_m - _THICK_M
    slab = boxes([[x, 0, sizes.height_m - _THICK_M / 2]], [[length_m, sizes.width_m, _THICK_M]], material)
    plinth = boxes([[x - 0.05, 0, under_m / 2]], [[length_m - 0.15, 0.8 * sizes.width_m, under_m]], material)
    return join_meshes([slab, plinth])


def _boards(rng: np.random.Generator, palette: Palette, sizes: TableTop) -> list[Mesh]:
    """Build up to three slightly leaning boards in at most two materials."""
    materials = [palette.add(draw_broad_material(rng, _BOARDS, sizes.distance_m)) for _ in range(2)]
    boards = []
    for _ in range(int(rng.integers(0, 4))):
        wide_m, high_m = sizes.distance_m * rng.uniform([0.15, 0.12], [0.6, 0.45])
        board = boxes([[0, 0, high_m / 2]], [[0.02, wide_m, high_m]], materials[int(rng.integers(2))])
        pose = rotation((0, 0, 1), rng.normal(0, 35)) @ rotation((0, 1, 0), rng.uniform(-20, 5))
        x = rng.uniform(-0.9 * sizes.behind_m, min(sizes.before_m, 0.4 * sizes.distance_m))
        y = rng.uniform(-0.4, 0.4) * sizes.distance_m
        boards.append(board.transform(pose).translate(x, y, sizes.height_m))
    return boards


def _backdrop(rng: np.random.Generator, palette: Palette, sizes: TableTop) -> Mesh:
    """Build a wall across the view and, sometimes, a side wall at right angles to it."""
    material = palette.add(draw_broad_material(rng, _BACKDROPS, sizes.distance_m + sizes.behind_m))
    wide_m, high_m = sizes.distance_m * rng.uniform(1.4, 3.0), rng.uniform(1.3, 2.4)
    wall = boxes([[-0.03, 0, high_m / 2]], [[0.06, wide_m, high_m]], material)
    if rng.random() < 0.3:
        other = palette.add(draw_broad_material(rng, _BACKDROPS, sizes.distance_m + sizes.behind_m))
        # The side wall ends before it reaches the cameras.
        deep_m = min(wide_m * rng.uniform(0.3, 0.6), sizes.behind_m + 0.35 * sizes.distance_m)
        side = boxes([[deep_m / 2, 0.0, high_m / 2]], [[deep_m, 0.06, high_m]], other)
        wall = join_meshes([wall, side.translate(y=rng.choice([-1, 1]) * rng.uniform(0.2, 0.45) * wide_m)])
    return wall.transform(rotation((0, 0, 1), rng.normal(0, 12))).translate(x=-sizes.behind_m)
