from dataclasses import replace

import numpy as np
import pytest
import torch
from learn_examples import checkpoint_of, complaint, recipe_of

from experiments.paper_worlds.scoring import score_worlds
from stereoweave.data.paper_layout import write_frame
from stereoweave.data.poses import Pose, write_poses
from stereoweave.data.samples import make_sample
from stereoweave.learn import checkpoint
from stereoweave.learn.data.sources import divide_frames
from stereoweave.learn.models import build_network
from stereoweave.stereo import StereoCamera, StereoPair

CAMERA = StereoCamera(focal_px=40.0, baseline_m=0.5, cx_px=31.5, cy_px=23.5)


def depth_m(world, frame):
    """Return the depth of a frame's plane: 2.0 to 2.9 m in the seen world, and 5 m in the other."""
    return 5.0 if world else 2 + 0.1 * frame


@pytest.fixture(scope="module")
def recipe(tmp_path_factory):
    """Return a recipe of two worlds of ten frames; from frame to frame, the camera moves by 1 cm.

    The upper half of every frame is farther away than 15 m.
    """
    root, rng = tmp_path_factory.mktemp("set"), np.random.default_rng(0)
    for world in range(2):
        for frame in range(10):
            images = rng.integers(0, 256, (2, 48, 64, 3), dtype=np.uint8)
            plane_m = np.full((48, 64), depth_m(world, frame), np.float32)
            plane_m[:24] = np.inf
            pair = StereoPair(left=images[0], right=images[1], camera=CAMERA)
            name = f"ship/{world:03d}/{frame:06d}"
            write_frame(root, name, make_sample(pair, CAMERA.disparity_px(plane_m)))
        poses = [Pose(time_s=i / 30, position_m=np.array([i / 100, 0, 0]), axes=np.eye(3)) for i in range(10)]
        write_poses(root, f"ship/{world:03d}", poses)
    return recipe_of(
        "fast_depth",
        dataset="paper_worlds",
        root=str(root),
        split="random",
        leave_out="disjoint",
        target="depth",
        exponent=1.5,
    )


@pytest.fixture(scope="module")
def run(recipe, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "tiny"
    folder.mkdir()
    torch.manual_seed(0)
    checkpoint.save(checkpoint_of(build_network(recipe).eval(), recipe), folder / "last.pt")
    return folder


@pytest.fixture(scope="module")
def rows(recipe, run):
    return {(row.split, row.method): row for row in score_worlds(recipe, [run])}


def test_every_method_is_scored_on_training_frames_and_on_both_splits(rows):
    methods = ["ground truth", "no warping", "sgbm", "nearest frame", "median", "tiny"]
    splits = ("training", "random", "disjoint")
    assert list(rows) == [(split, method) for split in splits for method in methods]
    assert {rows["training", method].pairs for method in methods} == {1}
    assert {rows["random", method].pairs for method in methods} == {1}
    assert {rows["disjoint", method].pairs for method in methods} == {10}
    assert [rows["random", method].steps for method in ("median", "tiny")] == [0, 20]


def test_a_training_frame_is_its_own_nearest_frame(rows):
    row = rows["training", "nearest frame"]
    assert (row.epe_cm, row.nearest_m) == (0, 0)


def test_in_a_seen_world_the_nearest_frame_is_a_neighbour(rows):
    row = rows["random", "nearest frame"]
    assert row.epe_cm == pytest.approx(10, abs=0.01)
    assert row.nearest_m == pytest.approx(0.01)


def test_in_an_unseen_world_the_nearest_frame_is_of_the_seen_one(recipe, rows):
    (held_out,) = (int(frame.name[-6:]) for frame in divide_frames(recipe).held_out)
    nearest = [held_out - 1 if i == held_out and i else (1 if i == held_out else i) for i in range(10)]
    expected_cm = [100 * (5 - depth_m(0, i)) for i in nearest]
    row = rows["disjoint", "nearest frame"]
    assert row.epe_cm == pytest.approx(np.mean(expected_cm), abs=0.01)
    assert row.epe_cm_sd == pytest.approx(np.std(expected_cm), abs=0.01)
    assert row.nearest_m == pytest.approx(0.001)  # 1 cm in one of ten frames


def test_the_truth_has_no_error_and_no_warping_is_at_15_m(rows):
    assert rows["disjoint", "ground truth"].epe_cm == 0
    assert rows["disjoint", "no warping"].epe_cm == pytest.approx(1000, abs=0.1)


def test_fewer_frames_are_scored_on_request_and_runs_are_optional(recipe):
    assert [row.pairs for row in score_worlds(recipe, [], 3)] == 5 * [1] + 5 * [1] + 5 * [3]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"leave_out": ""}, "a split in leave_out, found dataset = 'paper_worlds' and leave_out = ''"),
        ({"dataset": "paper"}, "expected dataset = 'paper_worlds'"),
    ],
)
def test_a_recipe_without_worlds_is_a_one_line_error(recipe, changes, told):
    assert told in complaint(lambda: list(score_worlds(replace(recipe, **changes), [])))


def test_a_run_of_other_pairs_and_equal_names_are_one_line_errors(recipe, run):
    other = replace(recipe, root="elsewhere")
    assert "tiny: expected a run with the held-out pairs of tiny" in complaint(
        lambda: list(score_worlds(other, [run]))
    )
    told = complaint(lambda: list(score_worlds(recipe, [run, run])))
    assert told.startswith("tiny: expected a unique name other than 'median' and 'nearest frame', found a")


@pytest.mark.parametrize("name", ["median", "nearest frame"])
def test_a_run_with_the_name_of_another_row_is_a_one_line_error(recipe, tmp_path, name):
    told = complaint(lambda: list(score_worlds(recipe, [tmp_path / name])))
    assert told.startswith(f"{name}: expected a unique name other than 'median' and 'nearest frame'")
