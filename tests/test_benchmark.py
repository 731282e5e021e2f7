import csv
import runpy

import numpy as np
import pytest

from stereoweave.benchmark import TURNS, fill_rows, opencv_sgbm, score_pairs, write_csv
from stereoweave.data.readers import Scene, read_scenes
from stereoweave.errors import StereoweaveError
from stereoweave.stereo import StereoPair


def scene_of(rng, name="noise", disparity_px=7):
    """Random dots, all at one disparity."""
    dots = rng.integers(0, 256, (48, 120, 3), dtype=np.uint8)
    pair = StereoPair(
        left=dots[:, :100], right=np.ascontiguousarray(dots[:, disparity_px : 100 + disparity_px])
    )
    return Scene(name=name, pair=pair, truth_px=np.full((48, 100), disparity_px, np.float32))


def constant(disparity_px):
    return lambda pair: np.full(pair.left.shape[:2], disparity_px, np.float32)


def test_rows_hold_the_errors_of_each_matcher_on_each_scene_and_their_means(rng):
    scenes = [scene_of(rng, "near", disparity_px=20), scene_of(rng, "far", disparity_px=7)]
    rows = score_pairs({"seven": constant(7.0), "eight": constant(8.5)}, scenes)
    found = {
        (row.matcher, row.scene): (row.epe_px, row.bad1_percent, row.bad2_percent, row.d1_percent)
        for row in rows
        if row.matcher != "sgbm"
    }
    assert found == {
        ("seven", "near"): (13.0, 100.0, 100.0, 100.0),
        ("seven", "far"): (0.0, 0.0, 0.0, 0.0),
        ("seven", "mean"): (6.5, 50.0, 50.0, 50.0),
        ("eight", "near"): (11.5, 100.0, 100.0, 100.0),
        ("eight", "far"): (1.5, 100.0, 0.0, 0.0),
        ("eight", "mean"): (6.5, 100.0, 50.0, 50.0),
    }


def test_times_are_relative_to_sgbm_in_the_same_row(rng):
    rows = score_pairs({"constant": constant(1.0)}, [scene_of(rng, "a"), scene_of(rng, "b")])
    times_ms = {(row.matcher, row.scene): row.time_ms for row in rows}
    for row in rows:
        assert row.time_relative == pytest.approx(row.time_ms / times_ms["sgbm", row.scene])
    for name in ("constant", "sgbm"):
        assert times_ms[name, "mean"] == pytest.approx((times_ms[name, "a"] + times_ms[name, "b"]) / 2)


@pytest.mark.parametrize("name", ["sgbm", "files/mean.onnx"])
def test_a_matcher_of_a_name_that_the_table_uses_itself_is_refused(rng, name):
    with pytest.raises(StereoweaveError, match=f"{name}: expected"):
        score_pairs({name: constant(1.0)}, [scene_of(rng)])


def test_matchers_take_turns_after_one_call_to_warm_up(rng):
    calls = []

    def noted(name):
        def match(pair):
            calls.append(name)
            return constant(1.0)(pair)

        return match

    score_pairs({"a": noted("a"), "b": noted("b")}, [scene_of(rng)])
    assert calls == ["a", "b"] * (1 + TURNS)


def test_sgbm_finds_the_disparity_of_random_dots_up_to_the_left_border(rng):
    disparity_px = opencv_sgbm()(scene_of(rng).pair)
    assert disparity_px.shape == (48, 100)
    np.testing.assert_array_equal(disparity_px[:, 10:90], 7)


def test_a_hole_takes_the_farther_of_its_neighbours_along_the_row():
    holes = [[-1, -1, -1, -1], [-1, 5, -1, 3], [2, -1, 0, 9], [-1, -1, -1, -1]]
    filled = [[-1, -1, -1, -1], [5, 5, 3, 3], [2, 2, 2, 9], [2, 2, 2, 9]]
    np.testing.assert_array_equal(fill_rows(np.array(holes, np.float32)), filled)


def test_a_csv_holds_every_row_under_a_header_and_the_machine(tmp_path, rng):
    rows = score_pairs({"seven": constant(7.0)}, [scene_of(rng)])
    write_csv(tmp_path / "pairs.csv", rows)
    with (tmp_path / "pairs.csv").open(newline="") as file:
        read = list(csv.DictReader(file))
    assert [(row["matcher"], row["scene"]) for row in read] == [
        ("sgbm", "noise"),
        ("seven", "noise"),
        ("sgbm", "mean"),
        ("seven", "mean"),
    ]
    assert read[1]["epe_px"] == "0"
    assert float(read[0]["time_ms"]) == pytest.approx(rows[0].time_ms, abs=1e-4)
    assert int(read[0]["cores"]) >= 1
    assert read[0]["cpu"]
    assert list(tmp_path.iterdir()) == [tmp_path / "pairs.csv"]


@pytest.mark.testdata
def test_sgbm_is_set_and_filled_as_the_referee_does(testdata):
    referee = runpy.run_path(str(testdata / "referee" / "score_pairs.py"))
    theirs, ours = referee["sgbm"](0), opencv_sgbm()
    for scene in read_scenes(testdata / "stereo" / "pairs"):
        expected = theirs(scene.pair.left, scene.pair.right)
        np.testing.assert_array_equal(ours(scene.pair), expected)
        np.testing.assert_array_equal(fill_rows(expected), referee["fill_rows"](expected))


@pytest.mark.testdata
def test_holes_are_filled_as_the_referee_does_whatever_the_map(testdata, rng):
    fill_rows_plain = runpy.run_path(str(testdata / "referee" / "score_pairs.py"))["fill_rows"]
    for share in (0.0, 0.5, 0.95, 1.0):
        holes = rng.uniform(0.1, 50, (40, 12)).astype(np.float32)
        holes[rng.random(holes.shape) < share] = -1
        np.testing.assert_array_equal(fill_rows(holes), fill_rows_plain(holes))
