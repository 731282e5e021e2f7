import json
import math
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
from view_examples import boxes_before_a_wall

from stereoweave.bench.pairs import make_matcher
from stereoweave.bench.view_scenes import ReferenceView, ViewScene, list_view_scenes
from stereoweave.bench.views import score_view_scenes, shift_image
from stereoweave.data.samples import make_sample
from stereoweave.errors import StereoweaveError
from stereoweave.stereo import Estimate, StereoPair

# PSNR of errors of 1 and of 10 grey levels, and of a view without errors (metrics.psnr_db).
LEVEL_DB, TEN_LEVELS_DB, PERFECT_DB = 48.1308036, 28.1308036, 148.1308036
OURS = ["nearest photograph", "cross-fade", "sgbm", "ground truth"]


def scene_of(sample, *views, name="shed"):
    return ViewScene(
        name=name,
        sample=sample,
        views=tuple(ReferenceView(position=position, image=image) for position, image in views),
    )


def wall(rng, shift_px=4, height=32, width=64):
    """Return a dotted plane at an integer disparity, as the two cameras and one halfway see it."""
    dots = rng.integers(0, 256, (height, width + shift_px, 3), np.uint8)
    left, middle, right = (
        np.ascontiguousarray(dots[:, start : start + width]) for start in (0, shift_px // 2, shift_px)
    )
    disparity_px = np.full((height, width), shift_px, np.float32)
    return make_sample(StereoPair(left=left, right=right), disparity_px, disparity_px), middle


def rows_of(networks, scenes):
    return score_view_scenes(networks, listed(scenes)).rows


def by_method(rows, scene):
    return {row.method: row for row in rows if row.scene == scene}


def listed(scenes):
    """Return a function that lists the scenes as if each were read."""
    return lambda: [partial(lambda scene: scene, scene) for scene in scenes]


def constant(disparity_px):
    """Return the factory of a matcher that finds one disparity everywhere."""

    def match(pair):
        map_px = np.full(pair.left.shape[:2], disparity_px, np.float32)
        return Estimate(
            disparity_px=map_px,
            right_disparity_px=map_px,
            confidence=np.ones_like(map_px),
            occluded=np.zeros(map_px.shape, bool),
        )

    return lambda: match


def test_a_plane_at_its_true_disparity_is_seen_without_error(rng):
    sample, middle = wall(rng)
    rows = by_method(
        rows_of({"right": constant(4), "wrong": constant(8)}, [scene_of(sample, (0.5, middle))]), "shed"
    )
    assert list(rows) == [*OURS, "right", "wrong"]
    for method in ("ground truth", "right"):
        assert rows[method].psnr_db == rows[method].smooth_psnr_db == pytest.approx(PERFECT_DB)
        assert (rows[method].mae, rows[method].ssim) == (0, pytest.approx(1))
    assert rows["wrong"].psnr_db < 20
    assert rows["ground truth"].time_ms > 0


def test_each_kind_of_pixel_has_its_own_error():
    # Halfway, the box is at columns 16 to 23. Its edges take columns 13 to 18 and 21 to 26. Only one
    # photograph shows columns 0, 13, 14, 15, 24, 25, 26 and 39 of the 40 (test_view_truth.py).
    edges = [*range(13, 19), *range(21, 27)]
    image = np.full((32, 40, 3), 101, np.uint8)
    image[:, edges] = 110
    scene = scene_of(boxes_before_a_wall((20, 28), height=32), (0.5, image))
    for row in by_method(rows_of({}, [scene]), "shed").values():
        assert (row.smooth_mae, row.edge_mae) == (1, 10)
        assert row.smooth_psnr_db == pytest.approx(LEVEL_DB)
        assert row.edge_psnr_db == pytest.approx(TEN_LEVELS_DB)
        assert row.one_mae == (2 * 1 + 6 * 10) / 8
        assert row.one_psnr_db == pytest.approx(LEVEL_DB - 10 * math.log10((2 * 1 + 6 * 100) / 8))
        assert row.mae == pytest.approx((28 * 1 + 12 * 10) / 40)
        assert row.psnr_db == pytest.approx(LEVEL_DB - 10 * math.log10((28 * 1 + 12 * 100) / 40))
        assert math.isnan(row.neither_psnr_db)
        assert math.isnan(row.neither_mae)


def test_pixels_that_neither_photograph_shows_have_their_own_error():
    image = np.full((32, 40, 3), 100, np.uint8)
    image[:, 12:14], image[:, 14:17] = 110, 106
    scene = scene_of(boxes_before_a_wall((10, 16), (18, 24), height=32), (0.5, image))
    row = by_method(rows_of({}, [scene]), "shed")["ground truth"]
    # The slit is at columns 12 and 13 (test_view_truth.py), and its borders are depth edges too. Of columns 3
    # to 22, which are all near an edge, 18 are known, and three of these are off by 6.
    assert (row.neither_mae, row.edge_mae, row.smooth_mae) == (10, 1, 0)
    assert row.neither_psnr_db == pytest.approx(TEN_LEVELS_DB)


def test_the_baselines_without_disparity_show_the_photographs_themselves():
    dark, bright = (np.full((32, 40, 3), level, np.uint8) for level in (100, 140))
    sample = make_sample(StereoPair(left=dark, right=bright), np.full((32, 40), np.nan))
    rows = rows_of({}, [scene_of(sample, (0.25, dark), (0.75, dark), (1.5, bright))])
    errors = {(row.method, row.position): row.mae for row in rows}
    assert [errors["nearest photograph", position] for position in (0.25, 0.75, 1.5)] == [0, 40, 0]
    assert [errors["cross-fade", position] for position in (0.25, 0.75, 1.5)] == [10, 30, 0]


def test_without_known_disparity_there_are_no_ground_truth_row_and_no_kinds():
    grey = np.full((32, 40, 3), 100, np.uint8)
    left_alone = make_sample(StereoPair(left=grey, right=grey), np.full((32, 40), 3.0))
    rows = by_method(rows_of({}, [scene_of(left_alone, (0.5, grey))]), "shed")
    assert list(rows) == OURS[:3]
    assert rows["sgbm"].mae == 0
    for kind in ("smooth", "edge", "one", "neither"):
        assert math.isnan(getattr(rows["sgbm"], f"{kind}_psnr_db"))
        assert math.isnan(getattr(rows["sgbm"], f"{kind}_mae"))


def test_a_mean_counts_every_scene_once_however_many_its_positions():
    grey = np.full((32, 40, 3), 100, np.uint8)
    plain = make_sample(StereoPair(left=grey, right=grey), np.full((32, 40), np.nan))
    known = boxes_before_a_wall((20, 28), height=32)
    shed = scene_of(plain, (0.25, grey + np.uint8(1)), (0.5, grey + np.uint8(2)), (0.75, grey + np.uint8(3)))
    barn = scene_of(known, (0.5, grey + np.uint8(10)), name="barn")
    rows = rows_of({}, [shed, barn])
    assert [row.scene for row in rows] == 9 * ["shed"] + 4 * ["barn"] + 4 * ["mean"]
    means = by_method(rows, "mean")
    assert means["sgbm"].mae == (2 + 10) / 2
    assert means["sgbm"].smooth_mae == means["ground truth"].mae == 10  # from the one scene that has it
    assert all(math.isnan(row.position) for row in means.values())


def test_shifting_an_image_by_a_pixel_takes_each_pixel_from_its_neighbour(rng):
    image = rng.integers(0, 256, (8, 9, 3), np.uint8)
    np.testing.assert_array_equal(shift_image(image, (1, 2))[2:, 1:], image[:-2, :-1])
    assert shift_image(image, (0, 0)) is image


def test_no_scene_at_all_is_an_error():
    with pytest.raises(StereoweaveError, match="at least one, found none"):
        rows_of({}, [])


@pytest.mark.testdata
def test_a_photograph_with_an_offset_scores_as_the_referee_says(testdata, tmp_path):
    (tmp_path / "cones").symlink_to(testdata / "stereo" / "views" / "cones")
    program = [
        sys.executable,
        testdata / "referee" / "score_views.py",
        tmp_path,
        "--json",
        tmp_path / "found.json",
    ]
    subprocess.run(program, check=True, capture_output=True)
    referee = json.loads((tmp_path / "found.json").read_text())["cones"]
    makers = {"best": partial(make_matcher, "best")}
    found = by_method(score_view_scenes(makers, partial(list_view_scenes, tmp_path)).rows, "cones")
    for method, name in (("nearest photograph",) * 2, ("cross-fade",) * 2, ("best", "stereoweave")):
        assert found[method].psnr_db == pytest.approx(referee[name]["psnr"], abs=1e-6)
        assert found[method].ssim == pytest.approx(referee[name]["ssim"], abs=1e-6)
