import csv
from dataclasses import replace

import numpy as np
import pytest
from learn_examples import box_before_a_wall

from stereoweave.bench.metrics import psnr_db, ssim
from stereoweave.bench.projected_views import measure_projection, score_projections
from stereoweave.bench.projection import project_right
from stereoweave.bench.tables import write_csv
from stereoweave.errors import StereoweaveError
from stereoweave.stereo import Sample, StereoCamera, View

WALL_PX, BOX_PX = 4, 12


def shifted(rng, shift_px, camera=None):
    """Return a sample of one flat wall."""
    dots = rng.integers(0, 256, (32, 100 + shift_px, 3), dtype=np.uint8)
    disparity_px = np.full((32, 100), shift_px, np.float32)
    return Sample(
        left=np.ascontiguousarray(dots[:, :100]),
        right=np.ascontiguousarray(dots[:, shift_px:]),
        disparity_px=disparity_px,
        right_disparity_px=disparity_px,
        occluded=np.zeros((32, 100), bool),
        right_occluded=np.zeros((32, 100), bool),
        camera=camera,
    )


def constant(disparity_px):
    return lambda sample: np.full(sample.left.shape[:2], disparity_px, np.float32)


def by_method(rows):
    return {row.method: row for row in rows}


def test_errors_count_sourced_pixels_alone_and_then_all_after_the_fill():
    right = np.full((16, 16, 3), 100, np.uint8)
    image, drawn = np.zeros_like(right), np.zeros((16, 16), bool)
    image[:, 4:], drawn[:, 4:] = 110, True
    image[:, 4], image[:, 15] = 140, 100
    errors = measure_projection(right, View(image=image, drawn=drawn))
    # Of the 12 columns with a source, one is off by 40, ten by 10, one by 0; the fill repeats the first.
    assert errors.mae_sourced == pytest.approx(140 / 12)
    assert errors.sourced_percent == 75
    assert errors.mae_filled == pytest.approx((140 + 4 * 40) / 16)
    filled = image.copy()
    filled[:, :4] = 140
    assert (errors.psnr_db, errors.ssim) == (psnr_db(filled, right), ssim(filled, right))


def test_a_view_without_any_source_has_no_error_of_sourced_pixels():
    black = np.zeros((16, 16, 3), np.uint8)
    errors = measure_projection(black + np.uint8(7), View(image=black, drawn=np.zeros((16, 16), bool)))
    assert np.isnan(errors.mae_sourced)
    assert (errors.sourced_percent, errors.mae_filled) == (0, 7)


def test_a_constant_shift_leaves_no_error_but_at_the_border_it_uncovers(rng):
    sample = shifted(rng, 7)
    errors = measure_projection(sample.right, project_right(sample.left, sample.disparity_px))
    assert (errors.mae_sourced, errors.sourced_percent) == (0, 93)
    border = np.abs(sample.right[:, 93:].astype(int) - sample.right[:, 92:93]).mean()
    assert errors.mae_filled == pytest.approx(border * 7 / 100)


def test_ground_truth_of_a_box_before_a_wall_is_off_only_where_the_left_camera_is_blind(rng):
    sample = box_before_a_wall(rng)
    truth = by_method(score_projections({}, [sample]))["ground truth"]
    # The wall leaves 4 columns uncovered at the right, and the box 12 - 4 in half of the rows.
    assert truth.sourced_percent == pytest.approx(100 * (1 - (4 + 8 / 2) / 96))
    assert (truth.epe_px, truth.mae_sourced) == (0, 0)
    assert 0 < truth.mae_filled < 10


def test_without_warping_the_right_view_is_the_left_image(rng):
    sample = box_before_a_wall(rng)
    row = by_method(score_projections({}, [sample]))["no warping"]
    # The box fills a quarter of the left view.
    assert row.epe_px == WALL_PX * 0.75 + BOX_PX * 0.25
    assert row.sourced_percent == 100
    difference = np.abs(sample.left.astype(int) - sample.right).mean()
    assert row.mae_sourced == row.mae_filled == pytest.approx(difference)


def test_sgbm_is_scored_with_its_holes_filled(rng):
    rows = by_method(score_projections({}, [shifted(rng, 7)]))
    # Its first columns see nothing in the right view; the fill gives them the wall's disparity.
    assert rows["sgbm"].epe_px < 0.1
    assert rows["sgbm"].mae_filled < rows["no warping"].mae_filled / 4


def test_rows_are_means_over_the_samples_in_order_of_the_methods(rng):
    samples = [shifted(rng, 7), shifted(rng, 20)]
    rows = score_projections({"seven": constant(7), "nine": constant(9)}, iter(samples))
    assert [row.method for row in rows] == ["ground truth", "no warping", "sgbm", "seven", "nine"]
    found = by_method(rows)
    assert (found["seven"].epe_px, found["seven"].sourced_percent) == (6.5, 93)
    assert (found["nine"].epe_px, found["nine"].sourced_percent) == (6.5, 91)
    assert found["ground truth"].sourced_percent == (93 + 80) / 2
    alone = by_method(score_projections({"seven": constant(7)}, samples[1:]))["seven"]
    assert found["seven"].mae_sourced == pytest.approx(alone.mae_sourced / 2)


def test_depth_errors_are_in_centimetres_through_each_sample_s_own_camera(rng):
    near = StereoCamera(focal_px=100, baseline_m=0.2, cx_px=50, cy_px=16)
    far = replace(near, baseline_m=0.4)
    samples = [shifted(rng, 10, near), shifted(rng, 8, far)]
    rows = by_method(score_projections({"five": constant(5)}, samples, max_depth_m=15))
    # 20 / 5 in place of 20 / 10 is 2 m off; 40 / 5 in place of 40 / 8 is 3 m off.
    assert rows["five"].epe_cm == pytest.approx(250)
    assert rows["ground truth"].epe_cm == 0


@pytest.mark.parametrize(("max_depth_m", "farthest_m"), [(None, 6), (10.0, 10), (6.5, 6.5)])
def test_depth_at_infinity_or_behind_it_counts_as_the_farthest_that_can_be(rng, max_depth_m, farthest_m):
    # Of 24 px m, the box of 12 px is 2 m away and the wall of 4 px is 6 m away.
    camera = StereoCamera(focal_px=100, baseline_m=0.24, cx_px=48, cy_px=32)
    sample = replace(box_before_a_wall(rng), camera=camera)
    methods = {"behind": constant(-1), "box": constant(12)}
    rows = by_method(score_projections(methods, [sample], max_depth_m))
    # The box fills a quarter of the left view.
    expected_cm = 25 * (farthest_m - 2) + 75 * (farthest_m - 6)
    assert rows["no warping"].epe_cm == rows["behind"].epe_cm == pytest.approx(expected_cm)
    assert rows["box"].epe_cm == pytest.approx(75 * 4)


def test_the_farthest_depth_is_each_sample_s_own_and_what_is_unknown_has_none(rng):
    camera = StereoCamera(focal_px=100, baseline_m=0.2, cx_px=50, cy_px=16)
    half = np.full((32, 100), 10, np.float32)
    half[:8], half[8:16] = np.nan, 0
    partly = replace(shifted(rng, 10, camera), disparity_px=half)
    rows = by_method(score_projections({"near": constant(20)}, [partly, shifted(rng, 4, camera)]))
    # The walls at 2 m and 5 m are the farthest surfaces; the estimate of 1 m is 1 m and 4 m in front of them.
    assert rows["no warping"].epe_cm == 0
    assert rows["near"].epe_cm == pytest.approx(250)


def test_without_any_known_truth_there_is_no_error_in_centimetres(rng):
    camera = StereoCamera(focal_px=100, baseline_m=0.2, cx_px=50, cy_px=16)
    unknown = replace(shifted(rng, 7, camera), disparity_px=np.full((32, 100), np.nan, np.float32))
    assert np.isnan(by_method(score_projections({}, [unknown]))["no warping"].epe_cm)


def test_without_a_camera_there_is_no_error_in_centimetres(rng):
    assert np.isnan(by_method(score_projections({}, [shifted(rng, 7)]))["ground truth"].epe_cm)


def test_unknown_truth_gives_no_source_and_counts_for_no_error(rng):
    sample = shifted(rng, 7)
    half = sample.disparity_px.copy()
    half[:16] = np.nan
    rows = by_method(score_projections({"eight": constant(8)}, [replace(sample, disparity_px=half)]))
    assert (rows["ground truth"].sourced_percent, rows["ground truth"].mae_sourced) == (93 / 2, 0)
    assert rows["eight"].epe_px == 1


@pytest.mark.parametrize("name", ["ground truth", "no warping", "sgbm"])
def test_a_method_with_the_name_of_a_baseline_is_refused(rng, name):
    with pytest.raises(StereoweaveError, match=f"^{name}: expected a name"):
        score_projections({name: constant(1)}, [shifted(rng, 7)])


def test_a_table_without_samples_is_refused():
    with pytest.raises(StereoweaveError, match="samples: expected at least one"):
        score_projections({}, [])


def test_the_csv_has_a_column_for_each_number_beside_the_machine(tmp_path, rng):
    write_csv(tmp_path / "views.csv", score_projections({}, [shifted(rng, 7)]))
    with (tmp_path / "views.csv").open(newline="") as file:
        first = next(csv.DictReader(file))
    assert list(first) == [
        *("method", "epe_px", "epe_cm", "mae_sourced", "sourced_percent", "mae_filled", "psnr_db", "ssim"),
        *("cpu", "cores", "opencv"),
    ]
    assert (first["method"], first["epe_cm"], first["sourced_percent"]) == ("ground truth", "nan", "93")
