from dataclasses import replace

import numpy as np
import pytest
from learn_examples import complaint

from stereoweave.learn.data.augment import (
    augment,
    crop,
    crop_and_scale,
    crop_camera,
    erase_patches,
    flip_rows,
    mirror,
    pad,
    recolour,
)
from stereoweave.stereo import Sample, StereoCamera

HEIGHT, WIDTH = 96, 144
NEAR_PX, SLOPE = 5.0, 0.05
CAMERA = StereoCamera(focal_px=90.0, baseline_m=0.1, cx_px=70.0, cy_px=40.0, doffs_px=6.0)


def picture(x, y):
    """Return a smooth pattern at points of the surface, so that resampling reproduces the pattern."""
    waves = [np.sin(x / 7 + y / 11 + phase) + np.sin(x / 13 - y / 9 + 2 * phase) for phase in (0, 1, 2)]
    return np.round(127.5 + 60 * np.stack(waves, -1)).astype(np.uint8)


@pytest.fixture
def sample():
    """Return a slanted wall: left column x has 5 + x / 20 px, so right column x shows (x + 5) / 0.95."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    seen = (x + NEAR_PX) / (1 - SLOPE)
    return Sample(
        left=picture(x, y),
        right=picture(seen, y),
        disparity_px=NEAR_PX + SLOPE * x,
        right_disparity_px=seen - x,
        occluded=x < NEAR_PX + SLOPE * x,
        right_occluded=seen > WIDTH - 1,
    )


def looked_up(values, columns):
    """Return rows of `values` interpolated at fractional columns, and the mask of columns inside."""
    before = np.clip(np.floor(columns).astype(int), 0, values.shape[1] - 2)
    share = (columns - before).reshape(*columns.shape, *[1] * (values.ndim - 2))
    rows = np.arange(len(values))[:, None]
    inside = (columns >= 0) & (columns <= values.shape[1] - 1)
    return (1 - share) * values[rows, before] + share * values[rows, before + 1], inside


def assert_views_agree(sample, grey_levels):
    """Assert that each view, sampled at the other view's matches, equals that other view."""
    columns = np.arange(sample.left.shape[1])
    for here, there, matches in (
        (sample.left, sample.right, columns - sample.disparity_px),
        (sample.right, sample.left, columns + sample.right_disparity_px),
    ):
        found, inside = looked_up(there.astype(float), matches)
        assert inside.mean() > 0.5
        assert np.abs(found - here)[inside].max() <= grey_levels


def assert_same(one, other):
    for name, value in vars(one).items():
        np.testing.assert_array_equal(value, getattr(other, name), err_msg=name)


def test_the_example_itself_is_exact(sample):
    assert_views_agree(sample, 2)


@pytest.mark.parametrize("seed", range(8))
def test_a_scaled_crop_stays_exact(sample, seed):
    part = crop_and_scale(sample, 64, 80, np.random.default_rng(seed))
    assert part.left.shape == part.right.shape == (64, 80, 3)
    assert_views_agree(part, 4)


def test_crops_are_scaled_up_and_down(sample):
    # The slope of the wall is the same at any scale; its disparity at the left border shows the scale.
    spans = [
        np.ptp(crop_and_scale(sample, 64, 80, np.random.default_rng(seed)).disparity_px) for seed in range(40)
    ]
    assert np.ptp(spans) < 0.2
    nearest = [crop_and_scale(sample, 64, 80, np.random.default_rng(s)).disparity_px.min() for s in range(40)]
    assert min(nearest) < 0.9 * NEAR_PX
    assert max(nearest) > 1.2 * NEAR_PX


def test_a_mirrored_sample_stays_exact(sample):
    assert_views_agree(mirror(sample), 2)
    np.testing.assert_array_equal(mirror(sample).left, sample.right[:, ::-1])
    np.testing.assert_array_equal(mirror(sample).occluded, sample.right_occluded[:, ::-1])


def test_a_sample_upside_down_stays_exact(sample):
    assert_views_agree(flip_rows(sample), 2)


@pytest.mark.parametrize("change", [mirror, flip_rows])
def test_mirroring_or_flipping_twice_restores_the_sample(sample, change):
    assert_same(change(change(sample)), sample)


@pytest.mark.parametrize("seed", range(8))
def test_an_augmented_sample_has_matching_disparities_and_the_requested_size(sample, seed):
    augmented = augment(sample, 64, 80, np.random.default_rng(seed))
    assert augmented.left.shape == augmented.right.shape == (64, 80, 3)
    assert augmented.left.dtype == augmented.right.dtype == np.uint8
    assert augmented.disparity_px.dtype == np.float32
    assert augmented.occluded.dtype == bool
    columns = np.arange(80)
    found_px, inside = looked_up(augmented.right_disparity_px, columns - augmented.disparity_px)
    np.testing.assert_allclose(found_px[inside], augmented.disparity_px[inside], atol=0.15)


def test_the_same_draws_give_the_same_sample(sample):
    one, other = (augment(sample, 64, 80, np.random.default_rng(3)) for _ in range(2))
    assert_same(one, other)


def test_both_views_get_the_same_order_of_colour_channels():
    image = np.full((4, 4, 3), (200, 100, 0), np.uint8)
    darkest = []
    for seed in range(20):
        left, right = recolour(image, image, np.random.default_rng(seed))
        assert left[0, 0].argmin() == right[0, 0].argmin()
        darkest.append(left[0, 0].argmin())
    assert len(set(darkest)) > 1


def test_both_views_are_recoloured_similarly():
    ramp = np.tile(np.arange(0, 240, 10, dtype=np.uint8)[None, :, None], (2, 1, 3))
    changes = []
    for seed in range(20):
        left, right = (image.astype(int) for image in recolour(ramp, ramp, np.random.default_rng(seed)))
        # Separate gains differ by up to 5 %, and gammas by up to 4 % of 1.4, most visibly at 1 / e of white.
        assert np.abs(left - right).max() < 60
        changes.append(np.abs(left - ramp).mean())
    assert max(changes) > 30


def test_erasing_puts_flat_patches_into_a_copy(rng):
    image = rng.integers(0, 256, (80, 100, 3), dtype=np.uint8)
    before = image.copy()
    found = erase_patches(image, rng)
    np.testing.assert_array_equal(image, before)
    changed = (found != image).any(2)
    assert 15 * 15 <= changed.sum() <= 2 * 63 * 63
    assert np.unique(found[changed], axis=0).shape[0] <= 3


@pytest.mark.parametrize("seed", range(4))
def test_a_crop_keeps_every_value_and_moves_the_principal_point(sample, seed):
    part = crop(replace(sample, camera=CAMERA), 30, 50, np.random.default_rng(seed))
    # The camera's principal point shows where the crop is.
    start, top = round(70 - part.camera.cx_px), round(40 - part.camera.cy_px)
    assert 0 <= start <= WIDTH - 50 and 0 <= top <= HEIGHT - 30
    for name, values in vars(sample).items():
        if name != "camera":
            np.testing.assert_array_equal(
                getattr(part, name), values[top : top + 30, start : start + 50], err_msg=name
            )
    assert part.camera == replace(CAMERA, cx_px=70.0 - start, cy_px=40.0 - top)


def test_crops_are_in_different_places_and_can_be_the_whole_sample(sample):
    whole = replace(sample, camera=CAMERA)
    centres = {crop(whole, 30, 50, np.random.default_rng(seed)).camera.cx_px for seed in range(20)}
    assert len(centres) > 10
    assert_same(crop(whole, HEIGHT, WIDTH, np.random.default_rng(0)), whole)


@pytest.mark.parametrize("size", [(HEIGHT + 1, 50), (30, WIDTH + 1)])
def test_a_crop_larger_than_the_sample_is_refused(sample, size):
    assert complaint(crop, sample, *size, np.random.default_rng(0)) == (
        f"crop_size = {list(size)}, expected at most [96, 144], the size of the pictures; use a smaller crop"
    )


def test_the_camera_of_an_enlarged_crop_has_a_longer_focal_length():
    assert crop_camera(CAMERA, 10, 20, 2.0, 0.5) == StereoCamera(
        focal_px=180.0, baseline_m=0.1, cx_px=120.5, cy_px=9.75, doffs_px=12.0
    )
    assert crop_camera(None, 10, 20) is None


@pytest.mark.parametrize("seed", range(4))
def test_scaling_a_sample_preserves_depth(sample, seed):
    # The depth of column x is 9 px m over 5 + x / 20 + 6 px.
    part = crop_and_scale(replace(sample, camera=CAMERA), 64, 80, np.random.default_rng(seed))
    scale = part.camera.focal_px / 90
    assert part.camera.doffs_px == pytest.approx(6 * scale)
    columns = (part.disparity_px / scale - NEAR_PX) / SLOPE
    expected_m = 9 / (NEAR_PX + SLOPE * columns + 6)
    np.testing.assert_allclose(part.camera.depth_m(part.disparity_px), expected_m, rtol=1e-5)
    # The camera also gives the columns of the crop: its principal point is 70 px right of the wall's start.
    first = 70 - part.camera.cx_px / scale
    np.testing.assert_allclose(columns[0], first + np.arange(80) / scale, atol=1.01)


def places_m(sample):
    """Return the left view's points in metres from the left camera: right, down and forward [H, W, 3]."""
    camera = sample.camera
    y, x = np.mgrid[: sample.left.shape[0], : sample.left.shape[1]]
    depth_m = camera.depth_m(sample.disparity_px)
    right, down = (x - camera.cx_px) / camera.focal_px, (y - camera.cy_px) / camera.focal_px
    return np.stack([right * depth_m, down * depth_m, depth_m], -1)


def test_a_flipped_sample_has_every_point_upside_down(sample):
    sample = replace(sample, camera=CAMERA)
    turned = places_m(flip_rows(sample))[::-1]
    np.testing.assert_allclose(turned, places_m(sample) * [1, -1, 1], rtol=1e-5, atol=1e-6)


def test_a_mirrored_sample_has_every_point_as_seen_from_the_other_camera(sample):
    sample = replace(sample, camera=CAMERA)
    seen = mirror(sample)
    # The sample's right camera is 10 cm further right, and its principal point doffs further right.
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    depth_m = 9 / (sample.right_disparity_px + 6)
    right_m, down_m = (x - 76.0) / 90 * depth_m, (y - 40.0) / 90 * depth_m
    expected = np.stack([-right_m, down_m, depth_m], -1)[:, ::-1]
    np.testing.assert_allclose(places_m(seen), expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(mirror(seen).camera.cx_px, 70)


@pytest.mark.parametrize("seed", range(4))
def test_a_sky_keeps_a_disparity_of_0(sample, seed):
    sky = np.zeros_like(sample.disparity_px)
    sample = replace(sample, disparity_px=sky, right_disparity_px=sky, camera=replace(CAMERA, doffs_px=0.0))
    augmented = augment(sample, 64, 80, np.random.default_rng(seed))
    np.testing.assert_array_equal(augmented.disparity_px, np.zeros((64, 80)))
    assert np.isinf(augmented.camera.depth_m(augmented.disparity_px)).all()


def test_a_pair_without_the_right_view_s_disparity_is_never_mirrored(sample):
    sample = replace(sample, right_disparity_px=np.full_like(sample.right_disparity_px, np.nan))
    for seed in range(12):
        augmented = augment(sample, 64, 80, np.random.default_rng(seed))
        assert np.isfinite(augmented.disparity_px).all()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("offset", [0.05, 0.14])
def test_a_pair_whose_right_crop_is_shifted_stays_exact(sample, seed, offset):
    part = crop_and_scale(sample, 64, 96, np.random.default_rng(seed), offset)
    assert_views_agree(part, 12)


@pytest.mark.parametrize("seed", range(5))
def test_padding_repeats_the_last_row_and_column_whose_disparity_is_known(sample, seed):
    padded = pad(sample, np.random.default_rng(seed))
    known = np.isfinite(padded.disparity_px)
    height, width = known.any(1).sum(), known.any(0).sum()
    assert HEIGHT * 3 // 4 <= height <= HEIGHT
    assert WIDTH * 3 // 4 <= width <= WIDTH
    here = np.s_[:height, :width]
    for name in ("left", "right", "disparity_px", "right_disparity_px", "occluded"):
        assert np.array_equal(getattr(padded, name)[here], getattr(sample, name)[here])
    for view in (padded.left, padded.right):
        assert (view[:, width:] == view[:, width - 1 : width]).all()
        assert (view[height:] == view[height - 1]).all()
    for values in (padded.disparity_px, padded.right_disparity_px):
        assert known.sum() == np.isfinite(values).sum() == np.isfinite(values[here]).sum() == height * width


def test_the_right_view_s_last_columns_are_occluded_once_the_left_view_lacks_what_they_show(sample):
    # All of the wall is 5 px away: the last 5 of the columns that remain show the first 5 replaced ones.
    far = np.full((HEIGHT, WIDTH), 5, np.float32)
    wall = replace(sample, disparity_px=far, right_disparity_px=far, right_occluded=np.zeros(far.shape, bool))
    padded = pad(wall, np.random.default_rng(1))
    height, width = (np.isfinite(padded.right_disparity_px).any(axis).sum() for axis in (1, 0))
    assert width < WIDTH
    expected = np.zeros(far.shape, bool)
    expected[:height, width - 5 : width] = True
    assert np.array_equal(padded.right_occluded, expected)


def test_a_quarter_of_the_rows_and_columns_are_padding_at_most(sample):
    found = [np.isfinite(pad(sample, np.random.default_rng(seed)).disparity_px) for seed in range(200)]
    assert min(known.any(1).sum() for known in found) == HEIGHT * 3 // 4
    assert max(known.any(1).sum() for known in found) == HEIGHT
    assert min(known.any(0).sum() for known in found) == WIDTH * 3 // 4
    assert max(known.any(0).sum() for known in found) == WIDTH


def test_shifting_the_right_crop_adds_its_offset_to_the_disparity():
    x = np.mgrid[:64, :96][1].astype(np.float32)
    flat = np.full((64, 96), 5, np.float32)
    sample = Sample(
        left=picture(x, x), right=picture(x + 5, x), disparity_px=flat, right_disparity_px=flat,
        occluded=flat < 0, right_occluded=flat < 0, camera=CAMERA,
    )  # fmt: skip
    part = crop_and_scale(sample, 64, 64, np.random.default_rng(0), 0.125)
    width = 64 / part.camera.focal_px * 90  # of the crop before scaling
    offset_px = round(0.125 * width)
    assert 0 < offset_px <= 12
    np.testing.assert_allclose(part.disparity_px, (5 + offset_px) * 64 / width, rtol=1e-5)
    # Depth is preserved: 9 px m over 5 + 6 px.
    np.testing.assert_allclose(part.camera.depth_m(part.disparity_px), 9 / 11, rtol=1e-5)


def test_the_requested_share_of_right_crops_is_shifted(sample):
    def nearest_px(share, seed):
        part = augment(replace(sample, camera=CAMERA), 48, 48, np.random.default_rng(seed), share)
        return part.camera.doffs_px / part.camera.focal_px

    moved_ones = [nearest_px(0.3, seed) < 6 / 90 - 1e-9 for seed in range(300)]
    # 90 of 300 are expected, a few of them shifted by less than half a pixel; the deviation is 8.
    assert 60 < sum(moved_ones) < 120
    assert not any(nearest_px(0, seed) < 6 / 90 - 1e-9 for seed in range(30))
