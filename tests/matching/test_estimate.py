from dataclasses import replace

import cv2
import numpy as np
import pytest
from image_forms import IMAGE_FORMS
from matcher_examples import of_fixed_size

import stereoweave as sw
from stereoweave.errors import StereoweaveError
from stereoweave.io.images import read_pair
from stereoweave.matching import estimate as matching
from stereoweave.matching import matcher as matcher_module
from stereoweave.matching.estimate import match, match_many
from stereoweave.matching.matcher import Matcher, model_file
from stereoweave.matching.options import MatchOptions
from stereoweave.matching.providers import PROVIDERS

FIELDS = ("disparity_px", "right_disparity_px", "confidence", "occluded")


@pytest.fixture(scope="module")
def matcher():
    return Matcher("small")


@pytest.fixture(scope="module")
def textured():
    return read_pair("tests/textured_pair/left.png", "tests/textured_pair/right.png")


def same(one, other):
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def moved(pair, by_px):
    """Return the pair with by_px fewer columns and disparities by_px lower."""
    return sw.StereoPair(
        left=np.ascontiguousarray(pair.left[:, by_px:]), right=np.ascontiguousarray(pair.right[:, :-by_px])
    )


def sure(estimate, confidence=0.9):
    return (estimate.confidence > confidence) & ~estimate.occluded


@pytest.mark.parametrize("refined", [False, True])
def test_a_pair_that_fits_the_network_gets_the_estimate_of_the_matcher(matcher, textured, refined):
    found = sw.estimate(textured.left, textured.right, refined=refined)
    same(found, matcher.estimate(textured.left, textured.right, refined=refined))


def test_raw_is_the_networks_own_disparity_alone_and_in_a_batch(matcher, textured):
    alone = matcher.estimate(textured.left, textured.right, raw=True)
    same(sw.estimate(textured.left, textured.right, raw=True), alone)
    same(match_many(matcher, [textured], MatchOptions(raw=True))[0], alone)
    filled = matcher.estimate(textured.left, textured.right)
    assert (np.abs(filled.disparity_px - alone.disparity_px)[alone.occluded] > 1).mean() > 0.1
    # Surely seen twice, and neither searched nor beside what is.
    kept = ~alone.occluded & (alone.disparity_px <= np.arange(textured.left.shape[1]))
    kept &= ~filled.occluded & (alone.confidence >= 0.85)
    kept &= cv2.erode(alone.confidence, np.ones((5, 5))) >= 0.45
    assert kept.mean() > 0.5
    assert np.abs(filled.disparity_px - alone.disparity_px)[kept].max() < 1.001


@pytest.mark.parametrize("form", IMAGE_FORMS)
def test_images_in_every_form_are_matched_like_arrays(textured, tmp_path, form):
    part = sw.StereoPair(
        left=np.ascontiguousarray(textured.left[200:264, 200:296]),
        right=np.ascontiguousarray(textured.right[200:264, 200:296]),
    )
    left, right = (
        IMAGE_FORMS[form](image, tmp_path / f"{side}.png")
        for side, image in (("left", part.left), ("right", part.right))
    )
    same(sw.estimate(left, right), sw.estimate(part.left, part.right))


@pytest.mark.parametrize("by_px", [60, 100])
def test_cropped_columns_lower_the_disparity_even_below_zero(matcher, textured, by_px):
    whole = matcher.estimate(textured.left, textured.right)
    found = match(matcher, moved(textured, by_px))
    clear = sure(whole)[:, by_px:] & sure(found)
    assert clear.mean() > 0.3
    off_px = found.disparity_px - (whole.disparity_px[:, by_px:] - by_px)
    assert found.disparity_px[clear].min() < -5
    assert np.mean(np.abs(off_px[clear]) > 1) < 0.03
    assert abs(np.median(off_px[clear])) < 0.1


def test_a_given_range_overrides_detection(matcher, textured):
    whole = matcher.estimate(textured.left, textured.right)
    same(match(matcher, textured, MatchOptions(range_px=(0, 192))), whole)
    found = match(matcher, textured, MatchOptions(range_px=(-20, 120)))
    clear = sure(whole) & sure(found)
    assert np.mean(np.abs(found.disparity_px - whole.disparity_px)[clear] > 1) < 0.03


def test_a_picture_twice_as_large_has_twice_the_disparity_even_if_it_is_matched_smaller(matcher, textured):
    twice = sw.StereoPair(
        left=cv2.resize(textured.left, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC),
        right=cv2.resize(textured.right, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC),
    )
    whole = matcher.estimate(textured.left, textured.right)
    found = match(matcher, twice, MatchOptions(range_px=(0, 440)))
    expected_px = 2 * cv2.resize(whole.disparity_px, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
    clear = cv2.resize(sure(whole).astype(np.uint8), None, fx=2, fy=2) > 0
    off_px = (found.disparity_px - expected_px)[clear & sure(found)]
    assert np.mean(np.abs(off_px) > 2) < 0.03
    assert abs(np.median(off_px)) < 0.2


def flat(rng, disparity_px, size=(160, 480)):
    """Return a pair of soft noise with the same disparity everywhere."""
    height, width = size
    wide = cv2.GaussianBlur(rng.integers(0, 256, (height, width + disparity_px, 3), np.uint8), (0, 0), 3)
    wide = cv2.normalize(wide, None, 0, 255, cv2.NORM_MINMAX)
    return sw.StereoPair(
        left=np.ascontiguousarray(wide[:, :width]), right=np.ascontiguousarray(wide[:, disparity_px:])
    )


def test_a_range_that_cuts_off_much_of_the_scene_is_noted(matcher, rng):
    (note,) = match(matcher, flat(rng, 37), MatchOptions(range_px=(0, 20))).notes
    assert str(note).endswith("outside the range of 0 to 20 px; widen it, or leave it out (range_px)")
    assert match(matcher, flat(rng, 37), MatchOptions(range_px=(0, 60))).notes == ()


@pytest.mark.parametrize("range_px", [(0, 300), (0, 500), (-200, 200), (None)])
def test_a_disparity_of_37_px_is_37_px_however_much_the_pair_is_reduced(matcher, rng, range_px):
    found = match(matcher, flat(rng, 37), MatchOptions(range_px=range_px))
    inner = np.s_[10:-10, 60:-60]
    assert abs(np.median(found.disparity_px[inner]) - 37) < 0.3
    assert abs(np.median(found.right_disparity_px[inner]) - 37) < 0.3
    assert np.mean(np.abs(found.disparity_px[inner] - 37) > 1) < 0.02


def test_a_surface_nearer_than_the_networks_range_is_found(matcher, rng):
    pair = flat(rng, 37, size=(320, 720))
    board = flat(rng, 0, size=(160, 200)).left
    pair.left[80:240, 450:650] = pair.right[80:240, 450 - 260 : 650 - 260] = board
    found_px = match(matcher, pair).disparity_px
    assert abs(np.median(found_px[90:230, 460:640]) - 260) < 1
    assert abs(np.median(found_px[:60, 200:600]) - 37) < 1


def test_a_pair_too_large_for_one_run_is_matched_at_a_smaller_size(matcher, rng, monkeypatch):
    pair = flat(rng, 37, size=(320, 480))
    for module in (matching, matcher_module):
        monkeypatch.setattr(module, "PIXEL_PAIRS_AT_ONCE", 400 * 400 * 266)
    small = matching._fit_network(matcher, pair)
    assert matcher.sees_whole(small.left.shape[1], small.left.shape[0])
    assert 375 < small.left.shape[1] < 400
    found_px = match(matcher, pair).disparity_px
    assert abs(np.median(found_px[10:-10, 60:-60]) - 37) < 0.3


@pytest.mark.parametrize("size", [(1500, 2000), (4000, 6000), (5774, 8660), (1000, 5000), (9000, 2000)])
def test_a_downscaled_pair_fits_one_run_without_seams(matcher, size):
    photo = np.broadcast_to(np.zeros((1, 1, 3), np.uint8), (*size, 3))
    seen = matching._fit_network(matcher, sw.StereoPair(left=photo, right=photo)).left
    assert matcher.sees_whole(seen.shape[1], seen.shape[0])
    assert seen.shape[1] ** 2 * seen.shape[0] > 0.85 * matching.PIXEL_PAIRS_AT_ONCE
    assert abs(seen.shape[1] / seen.shape[0] - size[1] / size[0]) < 0.01 * size[1] / size[0]


def test_a_wide_pair_fits_one_run_of_a_network_that_takes_multiples_of_32_rows():
    matcher = Matcher("base")
    assert matcher.multiple_of == 32
    photo = np.broadcast_to(np.zeros((1, 1, 3), np.uint8), (700, 4548, 3))
    seen = matching._fit_network(matcher, sw.StereoPair(left=photo, right=photo)).left
    assert matcher.sees_whole(seen.shape[1], seen.shape[0])
    assert seen.shape[1] > 2800


def test_a_video_frame_of_1920x1080_fits_one_run(matcher):
    assert matcher.sees_whole(1920, 1080)


@pytest.mark.parametrize("by_px", [40, 60])
def test_slightly_negative_disparities_are_matched(matcher, rng, by_px):
    """A wall is 3 px behind the plane of convergence, with a board in front of it."""
    pair = flat(rng, 37, size=(240, 480))
    board = flat(rng, 0, size=(100, 120)).left
    pair.left[70:170, 300:420] = pair.right[70:170, 300 - by_px : 420 - by_px] = board
    found_px = match(matcher, moved(pair, 40)).disparity_px
    assert abs(np.median(found_px[:60, 60:-60]) + 3) < 0.3
    assert abs(np.median(found_px[80:160, 270:370]) - (by_px - 40)) < 0.5


def test_a_small_pair_whose_disparities_are_all_negative_is_matched(matcher, textured):
    """The network finds matches left of the right picture, so almost all pixels seem to be occluded."""
    smaller = sw.StereoPair(
        left=cv2.resize(textured.left, (128, 96), interpolation=cv2.INTER_AREA),
        right=cv2.resize(textured.right, (128, 96), interpolation=cv2.INTER_AREA),
    )
    narrow = moved(smaller, 25)
    assert matcher.estimate(narrow.left, narrow.right).occluded.mean() > 0.5
    found, given = match(matcher, narrow), match(matcher, narrow, MatchOptions(range_px=(-27, 20)))
    assert np.median(given.disparity_px) < 0
    assert abs(np.median(found.disparity_px) - np.median(given.disparity_px)) < 1
    assert found.confidence.mean() > 0.5


@pytest.fixture(scope="module")
def best():
    return Matcher("best")


@pytest.fixture(scope="module")
def part(textured):
    """Return a crop of 160x96 px from the example."""
    left, right = (np.ascontiguousarray(x[200:296, 240:400]) for x in (textured.left, textured.right))
    return sw.StereoPair(left=left, right=right)


def test_best_is_base_at_one_and_a_half_times_the_size_and_refined(best, part):
    # The magnified run decides everywhere: the first run is nowhere more confident of another surface.
    found = sw.estimate(part.left, part.right, model="best")
    larger = (cv2.resize(x, (240, 144), interpolation=cv2.INTER_CUBIC) for x in (part.left, part.right))
    larger = tuple(larger)
    expected = Matcher("best").estimate(*larger)
    expected_px = cv2.resize(expected.disparity_px, (160, 96), interpolation=cv2.INTER_NEAREST_EXACT) / 1.5
    assert found.disparity_px.shape == found.confidence.shape == found.occluded.shape == (96, 160)
    # Everything agrees except what a median over 3x3 px changes.
    assert np.mean(np.abs(found.disparity_px - expected_px) > 0.2) < 0.05
    same(match_many(best, [part])[0], found)


@pytest.mark.parametrize("name", ["base", "best"])
def test_base_and_best_are_always_refined(part, name):
    matcher = Matcher(name)
    same(match(matcher, part, MatchOptions(refined=True)), match(matcher, part))


def test_other_networks_and_files_are_refined_on_request(part):
    file = Matcher(model_file("base"))
    same(match(file, part, MatchOptions(refined=True)), match(Matcher("base"), part))
    for matcher in (file, Matcher("small")):
        plain, refined = (match(matcher, part, MatchOptions(refined=how)) for how in (False, True))
        assert (plain.disparity_px != refined.disparity_px).any()


def test_the_best_estimate_mixes_no_surfaces():
    stripes_px = np.repeat([[6.0, 60.0, 6.0, 60.0]], 9, axis=1).repeat(90, axis=0).astype(np.float32)
    found = sw.Estimate(
        disparity_px=stripes_px,
        right_disparity_px=stripes_px,
        confidence=np.ones_like(stripes_px),
        occluded=stripes_px > 10,
    )
    grey = np.zeros((60, 24, 3), np.uint8)
    shrunk = matching._downsample(found, sw.StereoPair(left=grey, right=grey))
    np.testing.assert_allclose(np.unique(shrunk.disparity_px), [4, 40])
    np.testing.assert_array_equal(shrunk.occluded, shrunk.disparity_px > 10)


@pytest.mark.parametrize("range_px", [None, (0, 150), (-20, 60)])
def test_a_disparity_of_37_px_is_37_px_for_best(best, rng, range_px):
    texture = rng.integers(0, 256, (96, 400, 3), np.uint8)
    texture = cv2.GaussianBlur(texture, (0, 0), 1.5)
    left, right = (np.ascontiguousarray(texture[:, at : at + 300]) for at in (50, 87))
    found = match(best, sw.StereoPair(left=left, right=right), MatchOptions(range_px=range_px))
    assert found.disparity_px.shape == (96, 300)
    assert np.median(np.abs(found.disparity_px - 37)[:, 60:]) < 0.1


@pytest.mark.parametrize(
    ("size", "least", "most"), [((64, 80), 1.2, 1.5), ((60, 60), 1.5, 1.5), ((200, 200), 0, 0)]
)
def test_best_magnifies_as_far_as_one_run_allows(best, rng, monkeypatch, size, least, most):
    for module in (matcher_module, matching):
        monkeypatch.setattr(module, "PIXEL_PAIRS_AT_ONCE", 100 * 100 * 100)
    seen = []
    estimate_many = Matcher.estimate_many

    def noted(matcher, pairs, **options):
        seen.extend(pair.left.shape for pair in pairs)
        return estimate_many(matcher, pairs, **options)

    monkeypatch.setattr(Matcher, "estimate_many", noted)
    left, right = rng.integers(0, 256, (2, *size, 3), np.uint8)
    match(best, sw.StereoPair(left=left, right=right), MatchOptions(range_px=(0, 40)))
    assert all(best.sees_whole(width, height) for height, width, _ in seen)
    closer = [width / size[1] for _, width, _ in seen[1:]]
    assert [least <= magnification <= most for magnification in closer] == [True] * (most > 0)


def test_the_first_run_is_kept_where_it_is_more_confident_of_another_surface():
    closer, found = (
        sw.Estimate(
            disparity_px=np.full(size, px, np.float32),
            right_disparity_px=np.full(size, px, np.float32),
            confidence=np.full(size, confidence, np.float32),
            occluded=np.zeros(size, bool),
        )
        for size, px, confidence in (((36, 48), 9, 0.5), ((24, 32), 6, 0.5))
    )
    closer.confidence[:, 40:] = 0.4
    found.disparity_px[:12], found.right_disparity_px[:12] = 16, 16  # 24 px in the larger picture
    found.disparity_px[12:], found.right_disparity_px[12:] = 7, 7  # 10.5 px
    merged = matching._merge(closer, found)
    expected_px = np.full((36, 48), 9)
    expected_px[:18, 40:] = 24
    np.testing.assert_allclose(merged.disparity_px, expected_px)
    np.testing.assert_allclose(merged.confidence[:, :40], 0.5)
    np.testing.assert_allclose(merged.confidence[18:, 40:], 0.4)
    np.testing.assert_allclose(merged.confidence[:18, 40:], 0.5)


def test_masks_are_downscaled_with_the_pictures(rng):
    pair = flat(rng, 37)
    seen = np.ones(pair.left.shape[:2], bool)
    seen[:, :120] = False
    small = matching._resize(replace(pair, left_seen=seen), 2)
    assert small.right_seen is None
    np.testing.assert_array_equal(small.left_seen[:, [59, 60]], np.tile([False, True], (80, 1)))


@pytest.mark.parametrize("refined", [False, True])
def test_pixels_without_content_have_no_confidence_and_occlude_their_matches(matcher, rng, refined):
    pair = flat(rng, 37)
    left_seen, right_seen = np.ones((2, *pair.left.shape[:2]), bool)
    left_seen[:, :100] = False
    right_seen[:, 300:320] = False
    pair.right[~right_seen] = 0
    options = MatchOptions(refined=refined)
    found = match(matcher, replace(pair, left_seen=left_seen, right_seen=right_seen), options)
    assert (found.confidence[:, :100] == 0).all()
    assert np.median(found.confidence[:, 120:]) > 0.9
    assert found.occluded[20:-20, 338:356].mean() > 0.98
    np.testing.assert_allclose(found.disparity_px[20:-20, 338:356], 37, atol=1.5)
    assert found.occluded[20:-20, 120:330].mean() < 0.02


def test_matches_beyond_the_right_picture_are_occluded_whatever_the_range(matcher, rng):
    pair = flat(rng, 37)
    found = match(matcher, sw.StereoPair(left=pair.right, right=pair.left))
    assert abs(np.median(found.disparity_px[:, 60:-60]) + 37) < 0.3
    assert found.occluded[20:-20, -35:].mean() > 0.9
    assert found.occluded[20:-20, 40:-40].mean() < 0.02


def test_a_match_beyond_the_right_picture_takes_its_last_column(matcher, rng):
    pair = flat(rng, 37)
    right_seen = np.ones(pair.left.shape[:2], bool)
    right_seen[:, -1] = False
    found = match(matcher, sw.StereoPair(left=pair.right, right=pair.left, right_seen=right_seen))
    assert found.occluded[20:-20, -30:].mean() > 0.9
    assert found.occluded[20:-20, 40:-40].mean() < 0.02


def test_a_disparity_outside_a_given_range_is_clipped_and_gets_no_confidence(matcher, rng):
    for range_px, end_px in [((50, 90), 50), ((-20, 20), 20)]:
        found = match(matcher, flat(rng, 37), MatchOptions(range_px=range_px))
        for disparity_px in (found.disparity_px, found.right_disparity_px):
            assert range_px[0] <= disparity_px.min()
            assert disparity_px.max() <= range_px[1]
        inner = np.s_[10:-10, 60:-60]
        assert np.median(found.disparity_px[inner]) == end_px
        assert (found.confidence[inner] == 0).mean() > 0.98


@pytest.mark.parametrize("range_px", [(160, 170), (-170, -160)])
def test_a_range_that_no_pixel_can_have_is_refused_in_one_line(matcher, rng, range_px):
    with pytest.raises(
        StereoweaveError, match="expected disparities between -160 and 160 px, the width"
    ) as caught:
        match(matcher, flat(rng, 12, (64, 160)), MatchOptions(range_px=range_px))
    assert "\n" not in str(caught.value)


def test_a_range_beyond_the_pictures_width_is_clipped_to_it(matcher, rng):
    pair = flat(rng, 12, (64, 160))
    same(
        match(matcher, pair, MatchOptions(range_px=(-9000, 20))),
        match(matcher, pair, MatchOptions(range_px=(-160, 20))),
    )
    same(
        match(matcher, pair, MatchOptions(range_px=(0, 9000))),
        match(matcher, pair, MatchOptions(range_px=(0, 160))),
    )


@pytest.mark.parametrize("range_px", [(10, 10), (50, 0), (0, float("nan")), (float("-inf"), 10)])
def test_an_invalid_range_is_refused_in_one_line(matcher, textured, range_px):
    with pytest.raises(StereoweaveError, match="range_px: expected the least and the greatest") as caught:
        match(matcher, textured, MatchOptions(range_px=range_px))
    assert "\n" not in str(caught.value)


def test_plain_and_unrelated_pictures_are_matched_without_error(matcher, rng):
    plain = np.full((64, 96, 3), 90, np.uint8)
    assert (match(matcher, sw.StereoPair(left=plain, right=plain)).confidence == 0).all()
    noise = rng.integers(0, 256, (2, 64, 96, 3), np.uint8)
    pair = sw.StereoPair(left=noise[0], right=noise[1])
    same(match(matcher, pair), matcher.estimate(*noise))


def test_the_answer_does_not_depend_on_earlier_calls_of_other_sizes(rng):
    left, right = rng.integers(0, 256, (2, 64, 80, 3), np.uint8)
    first = sw.estimate(left, right)
    sw.estimate(left[:40, :70], right[:40, :70])
    np.testing.assert_array_equal(sw.estimate(left, right).disparity_px, first.disparity_px)


def test_a_shifted_pair_still_fits_one_run(rng, monkeypatch):
    for module in (matcher_module, matching):  # 96 columns fit, but not 8 more
        monkeypatch.setattr(module, "PIXEL_PAIRS_AT_ONCE", 96 * 96 * 64)
    seen = []
    estimate_many = Matcher.estimate_many

    def noted(matcher, pairs, **options):
        seen.extend(matcher.sees_whole(pair.left.shape[1], pair.left.shape[0]) for pair in pairs)
        return estimate_many(matcher, pairs, **options)

    monkeypatch.setattr(Matcher, "estimate_many", noted)
    left, right = rng.integers(0, 256, (2, 64, 96, 3), np.uint8)
    found = match(Matcher(), sw.StereoPair(left=left, right=right), MatchOptions(range_px=(-8, 40)))
    assert found.disparity_px.shape == (64, 96)
    assert seen == [True]


def test_a_pair_is_scaled_down_no_more_than_its_range_requires(matcher, rng, monkeypatch):
    seen = []
    estimate_many = Matcher.estimate_many

    def noted(matcher, pairs, **options):
        seen.extend(pair.left.shape for pair in pairs)
        return estimate_many(matcher, pairs, **options)

    monkeypatch.setattr(Matcher, "estimate_many", noted)
    match(matcher, flat(rng, 37), MatchOptions(range_px=(-100, 300)))
    # 400 px must fit into the 252 px that the network covers well: 480x160 px become 302x101, and the least
    # disparity becomes -62.9 px.
    assert seen == [(101, 302 + 63, 3)]


@pytest.mark.parametrize("options", [MatchOptions(), MatchOptions(range_px=(-8, 100), refined=True)])
def test_pairs_of_any_sizes_and_ranges_give_the_same_results_together_and_alone(rng, monkeypatch, options):
    monkeypatch.setitem(PROVIDERS, "cpu", replace(PROVIDERS["cpu"], batches=True))  # as on a GPU
    matcher = Matcher()
    noise = rng.integers(0, 256, (2, 64, 96, 3), np.uint8)
    shorter, negative = flat(rng, 12, (64, 96)), flat(rng, 30, (96, 160))
    seen = np.arange(96) > 20
    pairs = [
        flat(rng, 20, (64, 96)),
        sw.StereoPair(left=negative.right, right=negative.left),
        replace(shorter, left_seen=np.tile(seen, (64, 1))),
        sw.StereoPair(left=noise[0], right=noise[1]),
    ]
    for pair, found in zip(pairs, match_many(matcher, pairs, options), strict=True):
        alone = match(matcher, pair, options)
        np.testing.assert_array_equal(found.occluded, alone.occluded)
        for name in FIELDS[:3]:
            np.testing.assert_allclose(getattr(found, name), getattr(alone, name), atol=1e-3)


@pytest.mark.parametrize("range_px", [None, (0, 80), (-60, 80)])
def test_a_pair_larger_than_the_only_size_of_a_matcher_file_is_matched_smaller(tmp_path, rng, range_px):
    fixed = Matcher(of_fixed_size("small", tmp_path / "fixed.onnx", 160, 320))
    found_px = match(fixed, flat(rng, 37, (200, 480)), MatchOptions(range_px=range_px)).disparity_px
    assert found_px.shape == (200, 480)
    assert abs(np.median(found_px[10:-10, 60:-60]) - 37) < 0.5


@pytest.mark.parametrize("size", [(160, 321), (161, 320), (100, 321), (480, 640), (40, 2000), (320, 160)])
@pytest.mark.parametrize("least_px", [0, -1, -7, -31])
def test_every_input_of_a_fixed_size_matcher_fits_it(tmp_path, size, least_px):
    fixed = Matcher(of_fixed_size("small", tmp_path / "fixed.onnx", 160, 320))
    blank = np.zeros((*size, 3), np.uint8)
    shown = matching._prepare_first_input(fixed, sw.StereoPair(left=blank, right=blank), (least_px, 60))
    height, width = matching._shift(shown).left.shape[:2]
    assert fixed.sees_whole(width, height)
    # The pair is not smaller than necessary.
    assert max(height / 160, width / 320) > 0.97 or size[0] < 160
