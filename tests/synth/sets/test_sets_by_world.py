import io
from dataclasses import replace

import numpy as np
import pytest
from dataset_examples import error_of
from learn_examples import complaint
from rich.console import Console
from shard_examples import PaintedPairMaker, contents

from stereoweave.data.poses import read_poses
from stereoweave.data.readers import open_dataset
from stereoweave.synth.rendering.effects import PLAIN
from stereoweave.synth.rendering.raycast import Raycaster
from stereoweave.synth.sets import make as making
from stereoweave.synth.sets.make import make, read_set
from stereoweave.synth.sets.pair_rendering import RenderSpec, draw_stage_and_rig, render_pair

SPEC = RenderSpec(scene="pylon", seed=3, size_px=(48, 32), frames=5, by_world=True)
PAIR_MAKER = PaintedPairMaker()
# Three worlds of five frames.
NAMES = [f"pylon/{world:03d}/{frame:06d}" for world in range(3) for frame in range(5)]


@pytest.fixture(autouse=True)
def fixed_version(monkeypatch):
    monkeypatch.setattr(making, "generator_version", lambda: "01234567")


def made(out, pairs=15, spec=SPEC, pair_maker=PAIR_MAKER, layout="paper"):
    quiet = Console(file=io.StringIO())
    return make(spec, pairs, out, pair_maker=pair_maker, console=quiet, layout=layout)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(making, "generator_version", lambda: "01234567")
        assert made(out) == 15
    return out


@pytest.fixture(scope="module")
def camera():
    return Raycaster(PLAIN)


def test_frames_are_named_after_their_world_and_have_a_pose_each(finished):
    assert [frame.name for frame in open_dataset("paper", finished)] == NAMES
    assert list(read_poses(finished)) == NAMES
    facts = read_set(finished)
    assert (facts["by_world"], facts["frames"], facts["pairs"]) == (True, 5, 15)


def test_a_pose_is_that_of_the_rig_that_is_rendered(camera, finished):
    poses = read_poses(finished)
    for world, frame in ((0, 0), (1, 4), (2, 3)):
        _, rig = draw_stage_and_rig(camera, SPEC, world, frame)
        found = poses[NAMES[5 * world + frame]]
        assert found.time_s == pytest.approx(frame / 30)
        np.testing.assert_allclose(found.position_m, rig.position_m, atol=1e-8)
        np.testing.assert_allclose(found.axes, rig.axes, atol=1e-7)


def test_a_killed_set_resumes_and_gains_worlds_to_the_same_bytes(finished, tmp_path):
    error_of(lambda: made(tmp_path, 10, pair_maker=PaintedPairMaker(dies_at=7)))
    (tmp_path / "sums/pylon/000/000002.sha256").unlink()  # as if killed just before writing it
    (tmp_path / "poses/pylon/001.txt").unlink()
    assert made(tmp_path) == 9
    assert contents(tmp_path) == contents(finished)


def test_shards_by_world_have_the_same_poses(finished, tmp_path):
    assert made(tmp_path, layout="shards") == 15
    assert contents(tmp_path / "poses") == contents(finished / "poses")


def test_the_folder_of_a_set_by_world_is_no_set_of_videos_without_worlds(finished):
    message = error_of(lambda: made(finished, spec=replace(SPEC, by_world=False)))
    assert "expected by_world = null for this run, found true" in message


def test_the_camera_stays_in_its_world_and_the_rig_is_elasticfusion_s_unless_given(camera):
    stages, rigs = zip(*(draw_stage_and_rig(camera, SPEC, 1, frame) for frame in range(5)), strict=True)
    assert all(stage is stages[0] for stage in stages)
    assert {(rig.camera.focal_px, rig.camera.baseline_m) for rig in rigs} == {(39.6, 0.5)}  # 528 * 48 / 640
    assert len({rig.position_m[0] for rig in rigs}) == 5
    _, given = draw_stage_and_rig(camera, replace(SPEC, rig=(50.0, 0.25)), 1)
    assert (given.camera.focal_px, given.camera.baseline_m) == (50.0, 0.25)
    np.testing.assert_allclose(given.eye_m(0.5), rigs[0].eye_m(0.5))


def test_the_distance_from_the_target_may_be_given(camera):
    near = replace(SPEC, distance_m=(6.0, 6.0))
    stage, rig = draw_stage_and_rig(camera, near, 0, 3)
    assert np.linalg.norm(rig.eye_m(0.5) - stage.orbit.centre_m) == pytest.approx(6)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        (
            {"distance_m": (3.0, 2.0)},
            "distance_m: expected a least and a greatest distance above 0, found 3.0",
        ),
        ({"distance_m": (0.0, 2.0)}, "above 0, found 0.0 and 2.0"),
        ({"distance_m": (1.0, float("inf"))}, "above 0, found 1.0 and inf"),
        ({"distance_m": (1.0, float("nan"))}, "above 0, found 1.0 and nan"),
        ({"distance_m": (1.0, 2.0), "by_world": False}, "distance_m: expected none for a set without worlds"),
    ],
)
def test_an_invalid_distance_is_refused(changes, told):
    assert told in complaint(lambda: replace(SPEC, **changes))


def test_a_world_is_that_of_a_still_of_the_same_seed_and_number(camera):
    still, _ = draw_stage_and_rig(camera, replace(SPEC, by_world=False, frames=1), 2)
    world, _ = draw_stage_and_rig(camera, SPEC, 2)
    np.testing.assert_array_equal(world.world.mesh.corners_m, still.world.mesh.corners_m)


def test_a_pair_does_not_depend_on_the_pairs_made_before(camera):
    render_pair(camera, SPEC, 6)
    after = render_pair(camera, SPEC, 12).sample
    alone = render_pair(Raycaster(PLAIN), SPEC, 12).sample
    np.testing.assert_array_equal(after.left, alone.left)
    np.testing.assert_array_equal(after.disparity_px, alone.disparity_px)
