from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereoweave.io.images import read_image
from stereoweave.matching.exposure import Looks, equalise_grey, match_exposure, recolour
from stereoweave.matching.matcher import Matcher
from stereoweave.stereo import Estimate, StereoPair
from stereoweave.synth.rendering.effects import PLAIN
from stereoweave.synth.rendering.raycast import Raycaster
from stereoweave.synth.sets.pair_rendering import RenderSpec, render_pair

TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"
LEVELS = np.arange(256)
IDENTITY = np.repeat(LEVELS[:, None], 3, axis=1)
SHIFT_PX = 8


def levels(gain=(1.0, 1.0, 1.0), exponent=1.0):
    """Return the levels, uint8 [256, 3], that one image shows for levels 0, 1, ... 255 of another."""
    shares = np.array(gain) * (LEVELS[:, None] / 255) ** exponent
    return np.rint(255 * np.clip(shares, 0, 1)).astype(np.uint8)


DISTORTIONS = {
    "gain": levels((1.3, 1.3, 1.3)),
    "darker": levels((0.75, 0.75, 0.75)),
    "gamma": levels(exponent=1.2),
    "cast": levels((1.1, 1.0, 0.85)),
}


def seen_alike(height, width):
    """Return an estimate with one disparity and full confidence everywhere, and no occlusion."""
    return Estimate(
        disparity_px=np.full((height, width), SHIFT_PX, np.float32),
        right_disparity_px=np.full((height, width), SHIFT_PX, np.float32),
        confidence=np.ones((height, width), np.float32),
        occluded=np.zeros((height, width), bool),
    )


@pytest.fixture
def wall(rng):
    """Return a pair with a soft pattern of all levels from 10 to 245 at SHIFT_PX, equally exposed."""
    noise = cv2.GaussianBlur(rng.normal(size=(120, 160 + SHIFT_PX, 3)), (0, 0), 5)
    ranks = noise.reshape(-1, 3).argsort(axis=0).argsort(axis=0).reshape(noise.shape)
    picture = np.rint(10 + 235 * ranks / ranks.max()).astype(np.uint8)
    left, right = picture[:, :160].copy(), picture[:, SHIFT_PX:].copy()
    return StereoPair(left=left, right=right), seen_alike(120, 160)


@pytest.fixture(scope="module")
def matcher():
    return Matcher("small")


@pytest.fixture(scope="module")
def examples():
    return StereoPair(left=read_image(TEXTURED / "left.png"), right=read_image(TEXTURED / "right.png"))


def occurring(photo):
    """Return which levels, bool [256, 3], occur in at least 1 pixel in 500 and are not clipped."""
    shares = np.stack([np.bincount(channel.ravel(), minlength=256) for channel in cv2.split(photo)], axis=1)
    return (shares > photo[..., 0].size / 500) & (np.abs(IDENTITY - 127.5) < 122)


def assert_recovered(looks, left, distortion, within):
    errors = np.abs(looks.right_of_left - distortion)
    assert errors[occurring(left)].max() < within
    back = recolour(recolour(left, distortion.astype(np.float32)), looks.left_of_right)
    lost = recolour(left, distortion.astype(np.float32)) > 250
    assert np.abs(back.astype(int) - left)[occurring_pixels(left) & ~lost].max() < 2 * within


def occurring_pixels(photo):
    which = occurring(photo)
    return np.stack([which[channel, i] for i, channel in enumerate(cv2.split(photo))], axis=2)


@pytest.mark.parametrize("name", DISTORTIONS)
def test_a_distortion_of_the_right_image_is_recovered_within_2_levels(name, examples, matcher):
    right = recolour(examples.right, DISTORTIONS[name].astype(np.float32))
    looks = match_exposure(examples.left, right, matcher.estimate(examples.left, right))
    assert_recovered(looks, examples.left, DISTORTIONS[name], within=2)


def test_a_distortion_is_recovered_in_a_rendered_pair(matcher):
    sample = render_pair(Raycaster(PLAIN), RenderSpec(scene="bridge", seed=3, size_px=(640, 480)), 1).sample
    right = recolour(sample.right, DISTORTIONS["gain"].astype(np.float32))
    looks = match_exposure(sample.left, right, matcher.estimate(sample.left, right))
    assert_recovered(looks, sample.left, DISTORTIONS["gain"], within=2)


@pytest.mark.parametrize("name", DISTORTIONS)
def test_exact_matches_recover_a_distortion_within_1_level(name, wall):
    pair, estimate = wall
    looks = match_exposure(pair.left, recolour(pair.right, DISTORTIONS[name].astype(np.float32)), estimate)
    assert_recovered(looks, pair.left, DISTORTIONS[name], within=1.5)


def test_equally_exposed_images_need_no_correction(examples, matcher, wall):
    estimate = matcher.estimate(examples.left, examples.right)
    assert match_exposure(examples.left, examples.right, estimate) is None
    pair, estimate = wall
    assert match_exposure(pair.left, pair.right, estimate) is None


@pytest.mark.parametrize("noise_levels", [4, 12])
def test_images_that_differ_only_by_noise_need_no_correction(noise_levels, rng, examples, matcher):
    noise = rng.normal(0, noise_levels, examples.right.shape)
    right = np.clip(np.rint(examples.right + noise), 0, 255).astype(np.uint8)
    looks = match_exposure(examples.left, right, matcher.estimate(examples.left, right))
    if looks is not None:
        assert np.abs(looks.right_of_left - IDENTITY).max() < 0.5


def test_the_correction_grows_smoothly_with_the_difference(wall, rng):
    pair, estimate = wall
    # A white patch has level 251 in the right image. All other pixels are darker there by one, two or three
    # levels, in numbers that give the desired mean.
    patch = np.zeros(pair.left.shape, bool)
    patch[:20, 50:90] = True
    pair.left[patch] = 255
    share_of_pixels = rng.random(pair.right.shape)
    middle, white = [], []
    for difference in np.arange(0, 2.5, 0.1):
        darker = pair.right - np.floor(difference + share_of_pixels).astype(np.uint8)
        darker[np.roll(patch, -SHIFT_PX, axis=1)] = 251
        looks = match_exposure(pair.left, darker, estimate)
        change = np.zeros((256, 3)) if looks is None else looks.right_of_left - IDENTITY
        middle.append(change[40:200].mean())
        white.append(change[255].mean())
    assert middle[0] == white[0] == 0
    assert middle[-1] == pytest.approx(-2.4, abs=0.1) and white[-1] == pytest.approx(-4, abs=0.2)
    assert np.abs(np.diff(middle)).max() < 0.35 and np.abs(np.diff(white)).max() < 0.6


def test_the_correction_grows_smoothly_with_the_number_of_matches(wall):
    pair, estimate = wall
    right = recolour(pair.right, DISTORTIONS["darker"].astype(np.float32))
    changes = []
    for rows in range(0, 30):
        estimate.confidence[:] = np.where(np.arange(120)[:, None] < rows, 1, 0)
        estimate.confidence[:, 30:] = 0
        looks = match_exposure(pair.left, right, estimate)
        changes.append(0 if looks is None else (IDENTITY - looks.right_of_left)[200].mean())
    assert changes[2] == 0 and changes[-1] > 30
    assert np.abs(np.diff(changes)).max() < 12


@pytest.mark.parametrize("unknown", ["occluded", "confidence"])
def test_uncertain_matches_are_ignored(unknown, wall, rng):
    pair, estimate = wall
    right = recolour(pair.right, DISTORTIONS["gain"].astype(np.float32))
    values = getattr(estimate, unknown).copy()
    values[40:90, 50:120] = unknown == "occluded"
    estimate = replace(estimate, **{unknown: values})
    left = pair.left.copy()
    left[40:90, 50:120] = rng.integers(100, 200)
    without, with_others = (match_exposure(photo, right, estimate) for photo in (pair.left, left))
    np.testing.assert_array_equal(with_others.right_of_left, without.right_of_left)
    np.testing.assert_array_equal(with_others.left_of_right, without.left_of_right)


def test_matches_at_disparity_jumps_are_ignored(wall, rng):
    pair, estimate = wall
    estimate.disparity_px[:, 40:] = rng.integers(0, 40, (120, 120))
    right = recolour(pair.right, DISTORTIONS["cast"].astype(np.float32))
    looks = match_exposure(pair.left, right, estimate)
    assert_recovered(looks, pair.left, DISTORTIONS["cast"], within=2)


def test_some_wrong_matches_do_no_harm(wall, rng):
    pair, estimate = wall
    squares = rng.integers(0, 60, (12, 6)) * (rng.random((12, 1)) < 0.5)
    estimate.disparity_px[:, 100:] += np.kron(squares, np.ones((10, 10)))
    right = recolour(pair.right, DISTORTIONS["cast"].astype(np.float32))
    looks = match_exposure(pair.left, right, estimate)
    assert_recovered(looks, pair.left, DISTORTIONS["cast"], within=2)


@pytest.mark.parametrize(
    "nothing",
    [
        {"confidence": np.full((120, 160), 0.4, np.float32)},
        {"occluded": np.ones((120, 160), bool)},
        {"disparity_px": np.full((120, 160), 160, np.float32)},
    ],
)
def test_without_sure_matches_there_is_no_correction(nothing, wall):
    pair, estimate = wall
    right = recolour(pair.right, DISTORTIONS["gain"].astype(np.float32))
    assert match_exposure(pair.left, right, estimate) is not None
    assert match_exposure(pair.left, right, replace(estimate, **nothing)) is None


def test_mirroring_swaps_the_looks(wall):
    pair, estimate = wall
    pair = replace(pair, right=recolour(pair.right, DISTORTIONS["cast"].astype(np.float32)))
    mirrored = pair.mirror()
    looks = match_exposure(pair.left, pair.right, estimate)
    exchanged = match_exposure(mirrored.left, mirrored.right, estimate)
    np.testing.assert_allclose(exchanged.right_of_left[10:246], looks.left_of_right[10:246], atol=0.5)
    np.testing.assert_allclose(exchanged.left_of_right[10:246], looks.right_of_left[10:246], atol=0.5)


def test_a_sky_that_is_white_in_both_images_stays_white_in_both_looks(wall):
    pair, estimate = wall
    right = recolour(pair.right, DISTORTIONS["darker"].astype(np.float32))
    confidence = estimate.confidence.copy()
    left = pair.left.copy()
    left[:40], right[:40], confidence[:40] = 255, 255, 0
    looks = match_exposure(left, right, replace(estimate, confidence=confidence))
    assert (looks.right_of_left[255] > 254).all()
    np.testing.assert_allclose(looks.right_of_left[200], 150, atol=1)


def test_clipped_white_becomes_the_mean_level_of_the_other_image(wall):
    pair, estimate = wall
    left, right = (np.repeat(photo[..., :1], 3, axis=2) for photo in (pair.left, pair.right))
    right = recolour(right, DISTORTIONS["gain"].astype(np.float32))
    # A matcher has no confidence where an image is plain.
    estimate.confidence[np.roll(right[..., 0] == 255, SHIFT_PX, axis=1)] = 0
    looks = match_exposure(left, right, estimate)
    # A gain of 1.3 clips all levels above 255 / 1.3 = 196.2; levels up to 245 are equally frequent.
    np.testing.assert_allclose(looks.left_of_right[255], (196.5 + 245) / 2, atol=4)
    np.testing.assert_allclose(looks.left_of_right[250], 250 / 1.3, atol=1)
    assert (looks.right_of_left[200:] > 254).all()


def test_tables_are_monotonic_and_stay_in_range_for_any_images(rng):
    left, right = rng.integers(0, 256, (2, 12, 16, 3), np.uint8)
    left, right = (cv2.resize(photo, (64, 48), interpolation=cv2.INTER_CUBIC) for photo in (left, right))
    looks = match_exposure(left, np.maximum(right, 90), seen_alike(48, 64))
    for table in (looks.right_of_left, looks.left_of_right):
        assert table.min() >= 0 and table.max() <= 255 and np.diff(table, axis=0).min() >= 0
        assert table.dtype == np.float32 and table.shape == (256, 3)


def test_looks_are_interpolated_linearly_between_the_images():
    looks = Looks(
        right_of_left=np.minimum(2 * IDENTITY, 255).astype(np.float32),
        left_of_right=(IDENTITY / 2).astype(np.float32),
    )
    np.testing.assert_array_equal(looks.tables(0), [IDENTITY, looks.left_of_right])
    np.testing.assert_array_equal(looks.tables(1), [looks.right_of_left, IDENTITY])
    left, right = looks.tables(0.25)
    # A surface has level 100 in the left image and 200 in the right one, and 125 a quarter of the way
    # between.
    assert left[100].tolist() == right[200].tolist() == [125, 125, 125]
    np.testing.assert_array_equal(looks.tables(-0.5), looks.tables(0))
    np.testing.assert_array_equal(looks.tables(1.5), looks.tables(1))


def test_levels_are_rounded_and_an_images_own_look_changes_nothing(examples):
    table = IDENTITY.astype(np.float32)
    np.testing.assert_array_equal(recolour(examples.left, table), examples.left)
    table[[7, 8, 255]] = [[1.4, 1.6, 2.0], [3.4, 3.6, 4.0], [254.4, 254.6, 255.0]]
    photo = np.array([[[7, 7, 7], [8, 8, 8], [255, 255, 255]]], np.uint8)
    assert recolour(photo, table).tolist() == [[[1, 2, 2], [3, 4, 4], [254, 255, 255]]]


@pytest.mark.parametrize(("gain", "offset"), [(1, 0), (0.5, 40), (1.5, -30)])
def test_grey_levels_get_the_mean_and_the_contrast_of_the_left_picture(gain, offset):
    row = np.arange(60, 188, 2, dtype=np.uint8)
    grey = np.repeat(row[None], 64, axis=0)
    right = np.repeat(grey[..., None], 3, axis=2)
    left = np.rint(gain * np.roll(right, SHIFT_PX, 1) + offset).astype(np.uint8)
    estimate = replace(seen_alike(64, 64), occluded=np.tile(np.arange(64) < SHIFT_PX, (64, 1)))
    _, equalised = equalise_grey(StereoPair(left=left, right=right), estimate)
    np.testing.assert_allclose(equalised, gain * grey + offset, atol=1)


def test_grey_levels_without_visible_pixels_stay(rng):
    left, right = (rng.integers(0, 256, (64, 64, 3), np.uint8) for _ in range(2))
    nothing = replace(seen_alike(64, 64), occluded=np.ones((64, 64), bool))
    greys = equalise_grey(StereoPair(left=left, right=right), nothing)
    for image, grey in zip((left, right), greys, strict=True):
        np.testing.assert_array_equal(grey, cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
