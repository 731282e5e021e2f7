import csv
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments.paper_sets.measuring import measure_sets, moved_px
from experiments.paper_sets.sets import PaperSet, read_sets
from stereoweave.learn.recipe import read_recipe
from stereoweave.stereo import StereoCamera
from stereoweave.synth.viewpoints import PosedRig
from stereoweave.synth.world import RenderedView

ROOT = Path(__file__).parents[3]
SETS = read_sets()
CAMERA = StereoCamera(focal_px=100.0, baseline_m=0.5, cx_px=31.5, cy_px=23.5)
RIG = PosedRig(camera=CAMERA, size_px=(64, 48), position_m=np.zeros(3), axes=np.eye(3))


class Wall:
    """A renderer that shows a wall 4 m ahead, with the target in its left quarter, below a sky."""

    name = "wall"

    def depth_m(self, world, rig, position):
        depth_m = np.full(rig.size_px[::-1], 4.0, np.float32)
        depth_m[: len(depth_m) // 2] = np.inf
        return depth_m

    def render_views(self, world, rig, positions):
        target = np.zeros(rig.size_px[::-1], bool)
        target[:, : rig.size_px[0] // 4] = True
        image = np.zeros((*target.shape, 3), np.uint8)
        return [
            RenderedView(image=image, depth_m=self.depth_m(world, rig, place), target=target)
            for place in positions
        ]


def test_the_eight_scenes_of_the_paper_have_25_000_pairs():
    names = ["propeller", "ship", "antenna", "wind_turbine", "pylon", "crane", "bridge", "refinery"]
    assert [one.scene for one in SETS] == names
    assert sum(one.pairs for one in SETS) == 25_000


def test_the_docs_have_the_command_of_every_set():
    told = (ROOT / "docs/paper-worlds.md").read_text(encoding="utf-8")
    commands = re.findall(r"^stereoweave synth make .+$", told, re.MULTILINE)
    assert commands == [one.command((640, 480), f"runs/worlds/{one.scene}") for one in SETS]


def test_a_command_has_the_focal_length_of_its_size():
    one = PaperSet(
        scene="ship", seed=3, worlds=2, frames=7, focal_px=528, baseline_m=0.25, distance_m=(2.5, 3.0)
    )
    assert one.command((320, 240), "out") == (
        "stereoweave synth make ship --worlds 2 --frames 7 --seed 3 --size 320x240 --rig 264 0.25 "
        "--distance 2.5 3 --layout paper -o out"
    )
    assert one.spec((320, 240)).rig == (264.0, 0.25)


def test_the_recipe_s_largest_disparity_at_half_the_paper_s_size_covers_the_nearest_surface_of_its_set():
    recipe = read_recipe(ROOT / "recipes/paper/propeller_worlds.toml")
    with (ROOT / "results/paper_sets/sets.csv").open() as file:
        nearest_m = {row["scene"]: float(row["nearest_m"]) for row in csv.DictReader(file)}
    one = next(one for one in SETS if one.scene == Path(recipe.root).name)
    focal_px, baseline_m = one.spec((320, 240)).rig
    # 264 px * 0.25 m / 64 px is 1.03 m.
    assert focal_px * baseline_m / recipe.max_disparity_px < nearest_m[one.scene]


def test_pixels_of_a_wall_move_by_focal_length_times_shift_over_depth():
    after = replace(RIG, position_m=np.array([0.1, 0, 0]))
    np.testing.assert_allclose(moved_px(np.full((48, 64), 5.0), RIG, after), 2.0)


def test_pixels_at_the_centre_stay_when_the_camera_moves_towards_them():
    after = replace(RIG, position_m=np.array([0, 0, 1.0]))
    moved = moved_px(np.full((48, 64), 2.0), RIG, after)
    assert moved[23, 31] == pytest.approx(0.5 * 2**0.5)  # half a pixel from the centre, now twice as far
    assert np.isinf(moved_px(np.full((48, 64), 0.5), RIG, after)).all()


def test_a_set_is_measured_and_the_mean_of_all_sets_comes_last():
    one = replace(SETS[1], worlds=2, frames=5)
    rows, depths = measure_sets([one], Wall(), (64, 48), every=2)
    assert [row.scene for row in rows] == ["ship", "all"]
    assert (rows[0].pairs, rows[0].measured) == (10, 4)  # frames 0 and 2 of both worlds
    assert (rows[0].nearest_m, rows[0].median_m, rows[0].known_percent) == (4.0, 4.0, 50.0)
    assert (rows[0].target_percent, rows[0].next_cm) == (25.0, 0.0)
    assert [(row.from_m, row.to_m) for row in depths if row.percent and row.scene == "ship"] == [
        (4, 5),
        (15, float("inf")),
    ]
    assert {row.percent for row in depths} == {0.0, 50.0}
