import csv
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from stereoweave.bench.opencv_matchers import OPENCV_MATCHERS
from stereoweave.bench.pairs import TURNS, add_memory, make_matcher, merge_makers, score_pairs
from stereoweave.bench.tables import MEAN, write_csv
from stereoweave.data.readers import Scene
from stereoweave.errors import MatcherError, StereoweaveError
from stereoweave.stereo import Estimate, StereoPair


def scene_of(rng, name="noise", disparity_px=7):
    """Return a scene of random dots, all at one disparity."""
    dots = rng.integers(0, 256, (48, 120, 3), dtype=np.uint8)
    pair = StereoPair(
        left=dots[:, :100], right=np.ascontiguousarray(dots[:, disparity_px : 100 + disparity_px])
    )
    return Scene(name=name, pair=pair, truth_px=np.full((48, 100), disparity_px, np.float32))


def scores_of(makers, scenes):
    """Return the result of `score_pairs` for scenes that are already read."""
    return score_pairs(makers, lambda: [partial(lambda scene: scene, scene) for scene in scenes])


def constant(disparity_px):
    """Return the factory of a matcher that finds one disparity everywhere."""
    return lambda: lambda pair: np.full(pair.left.shape[:2], disparity_px, np.float32)


def certain(disparity_px, confidence):
    """Return the factory of a matcher that returns one disparity everywhere as an Estimate."""

    def match(pair):
        found_px = np.full(pair.left.shape[:2], disparity_px, np.float32)
        claimed = np.full(pair.left.shape[:2], confidence, np.float32)
        return Estimate(
            disparity_px=found_px,
            right_disparity_px=found_px,
            confidence=claimed,
            occluded=np.zeros(found_px.shape, bool),
        )

    return lambda: match


def by_matcher(rows, scene=MEAN):
    return {row.matcher: row for row in rows if row.scene == scene}


def with_step(scene, behind_px):
    """Return the scene with another true disparity in its left half."""
    truth_px = scene.truth_px.copy()
    truth_px[:, :50] = behind_px
    return Scene(name=scene.name, pair=scene.pair, truth_px=truth_px)


def test_rows_hold_the_errors_of_each_matcher_on_each_scene_and_their_means(rng):
    scenes = [scene_of(rng, "near", disparity_px=20), scene_of(rng, "far", disparity_px=7)]
    rows = scores_of({"seven": constant(7.0), "eight": constant(8.5)}, scenes).rows
    found = {
        (row.matcher, row.scene): (row.epe_px, row.bad1_percent, row.bad2_percent, row.d1_percent)
        for row in rows
        if row.matcher in ("seven", "eight")
    }
    assert found == {
        ("seven", "near"): (13.0, 100.0, 100.0, 100.0),
        ("seven", "far"): (0.0, 0.0, 0.0, 0.0),
        ("seven", "mean"): (6.5, 50.0, 50.0, 50.0),
        ("eight", "near"): (11.5, 100.0, 100.0, 100.0),
        ("eight", "far"): (1.5, 100.0, 0.0, 0.0),
        ("eight", "mean"): (6.5, 100.0, 50.0, 50.0),
    }


def test_errors_by_class_are_those_of_each_scene_and_their_means(rng):
    near, far = scene_of(rng, "near", disparity_px=20), scene_of(rng, "far", disparity_px=7)
    occluded = np.zeros(far.truth_px.shape, bool)
    occluded[:, 50:60] = True
    makers = {"seven": constant(7.0)}
    rows = scores_of(makers, [near, replace(far, occluded=occluded)]).class_rows
    found = {
        (row.scene, row.pixel_class): (row.share_percent, row.bad1_percent, row.epe_px)
        for row in rows
        if row.matcher == "seven"
    }
    expected = {
        ("near", "outside"): (20, 20, 13),
        ("near", "occluded"): (0, 0, math.nan),
        ("near", "all"): (100, 100, 13),
        ("far", "outside"): (7, 0, 0),
        ("far", "occluded"): (10, 0, 0),
        ("far", "all"): (100, 0, 0),
        ("mean", "outside"): (13.5, 10, 6.5),
        ("mean", "occluded"): (5, 0, 0),
        ("mean", "all"): (100, 50, 6.5),
    }
    for key, numbers in expected.items():
        assert found[key] == pytest.approx(numbers, nan_ok=True), key


def test_times_are_relative_to_sgbm_in_the_same_row(rng):
    rows = scores_of({"constant": constant(1.0)}, [scene_of(rng, "a"), scene_of(rng, "b")]).rows
    times_ms = {(row.matcher, row.scene): row.time_ms for row in rows}
    for row in rows:
        assert row.time_relative == pytest.approx(row.time_ms / times_ms["sgbm", row.scene])
    for name in ("constant", "sgbm"):
        assert times_ms[name, "mean"] == pytest.approx((times_ms[name, "a"] + times_ms[name, "b"]) / 2)


@pytest.mark.parametrize("name", ["sgbm", "files/mean.onnx", "bm.onnx"])
def test_a_matcher_with_the_name_of_another_row_is_refused(rng, name):
    with pytest.raises(StereoweaveError, match=f"{name}: expected"):
        scores_of({name: constant(1.0)}, [scene_of(rng)])


def test_groups_of_matchers_become_one_unless_two_share_a_name():
    one, two, three = constant(1.0), constant(2.0), constant(3.0)
    merged = merge_makers({"a": one}, {}, {"b": two, "c": three})
    assert list(merged.items()) == [("a", one), ("b", two), ("c", three)]
    with pytest.raises(StereoweaveError, match="b: expected a name that no other row of the table uses"):
        merge_makers({"a": one, "b": two}, {"b": three})


def test_matchers_take_turns_after_the_calls_that_warm_them_up(rng):
    calls = []

    def noted(name, make):
        def match(pair):
            calls.append(name)
            return make()(pair)

        return lambda: match

    makers = {"map": noted("map", constant(1.0)), "estimate": noted("estimate", certain(1.0, 0.5))}
    scores_of(makers, [scene_of(rng)])
    # The left-right check of a map matches the mirrored pair too.
    assert calls == ["map", "map", "estimate"] + ["map", "estimate"] * TURNS


def test_a_row_has_the_errors_and_flying_pixels_near_edges(rng):
    scenes = [with_step(scene_of(rng, "step"), 27), scene_of(rng, "flat")]
    rows = scores_of({"between": constant(17.0), "before": constant(27.0)}, scenes).rows
    for of in (by_matcher(rows, "step"), by_matcher(rows)):  # the flat scene is not part of the mean
        assert (of["between"].edge_epe_px, of["before"].edge_epe_px) == (10, 10)
        assert (of["between"].edge_bad1_percent, of["before"].edge_bad1_percent) == (100, 50)
        assert (of["between"].flying_percent, of["before"].flying_percent) == (100, 0)
    assert math.isnan(by_matcher(rows, "flat")["between"].flying_percent)


def test_only_a_probability_has_a_calibration_error(rng):
    scene = with_step(scene_of(rng), 27)
    rows = scores_of({"sure": certain(7.0, 0.9), "map": constant(7.0)}, [scene]).rows
    # Half of the pixels are right.
    assert by_matcher(rows)["sure"].calibration_error == pytest.approx(0.4)
    assert math.isnan(by_matcher(rows)["map"].calibration_error)


def test_the_mean_row_has_the_area_between_the_mean_curves(rng):
    scenes = [with_step(scene_of(rng, "a"), 27), with_step(scene_of(rng, "b"), 12)]
    scores = scores_of({"flat": certain(7.0, 0.5)}, scenes)
    curves, row = scores.curves["flat"], by_matcher(scores.rows)["flat"]
    np.testing.assert_allclose(curves.epe_px.kept, (10 + 2.5) / 2)
    np.testing.assert_allclose(curves.bad1_percent.kept, 50)
    assert row.ause_px == pytest.approx(curves.epe_px.ause)
    assert row.ause_bad1_percent == pytest.approx(curves.bad1_percent.ause)
    # With p dropped, the oracle keeps 100 (1/2 - p) / (1 - p) % bad ones; its integral is 50 (1 - ln 2).
    assert row.ause_bad1_percent == pytest.approx(95 / 2 - 50 * (1 - math.log(2)), abs=0.02)


def test_the_holes_of_a_map_are_filled_and_least_confident(rng):
    def half():
        def match(pair):
            found_px = np.full(pair.left.shape[:2], 7, np.float32)
            found_px[:, 30:70] = -1
            return found_px

        return match

    scene = scene_of(rng)
    truth_px = scene.truth_px.copy()
    truth_px[:, 30:70] = 12
    scores = scores_of({"half": half}, [Scene(name="a", pair=scene.pair, truth_px=truth_px)])
    assert by_matcher(scores.rows)["half"].epe_px == pytest.approx(2)
    assert scores.curves["half"].epe_px.kept[-1] == 0


def test_a_scene_without_known_disparity_is_left_out_of_the_means(rng):
    scene = scene_of(rng)
    unknown = Scene(name="unknown", pair=scene.pair, truth_px=np.full_like(scene.truth_px, np.nan))
    scores = scores_of({"eight": certain(8.0, 0.5)}, [unknown, scene])
    assert math.isnan(by_matcher(scores.rows, "unknown")["eight"].calibration_error)
    assert by_matcher(scores.rows)["eight"].epe_px == 1
    np.testing.assert_array_equal(scores.curves["eight"].epe_px.kept, 1)


def test_no_scene_is_an_error():
    with pytest.raises(StereoweaveError, match="expected at least one, found none"):
        scores_of({}, [])


def test_an_unknown_model_is_an_error_before_any_scene_is_read():
    with pytest.raises(MatcherError, match=r"none.onnx"):
        score_pairs({"none": partial(make_matcher, "none.onnx")}, lambda: pytest.fail("was listed"))


def test_mean_rows_have_the_memory_for_the_largest_pair(rng):
    small, large = scene_of(rng), scene_of(rng)
    wide = np.tile(large.pair.left, (1, 2, 1))
    large = Scene(
        name="large", pair=StereoPair(left=wide, right=wide), truth_px=np.ones((48, 200), np.float32)
    )
    scores = scores_of({}, [small, large, small])
    assert scores.largest is large.pair
    rows = add_memory([row for row in scores.rows if row.matcher == "sgbm"], {}, scores.largest)
    assert [math.isnan(row.memory_mb) for row in rows] == [True, True, True, False]
    assert 0 < rows[-1].memory_mb < 100


def test_a_csv_holds_every_row_under_a_header_and_the_machine(tmp_path, rng):
    rows = scores_of({"seven": constant(7.0)}, [scene_of(rng)]).rows
    write_csv(tmp_path / "pairs.csv", rows)
    with (tmp_path / "pairs.csv").open(newline="") as file:
        read = list(csv.DictReader(file))
    everyone = [*OPENCV_MATCHERS, "seven"]
    assert [(row["matcher"], row["scene"]) for row in read] == [
        (name, scene) for scene in ("noise", "mean") for name in everyone
    ]
    assert read[len(OPENCV_MATCHERS)]["epe_px"] == "0"
    assert float(read[0]["time_ms"]) == pytest.approx(rows[0].time_ms, abs=1e-4)
    assert int(read[0]["cores"]) >= 1
    assert read[0]["cpu"]
    assert list(tmp_path.iterdir()) == [tmp_path / "pairs.csv"]
