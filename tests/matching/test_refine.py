import cv2
import numpy as np
import pytest
from plain_refining import plain_census, plain_costs, plain_pick, plain_settled, plain_sums

from stereoweave.errors import StereoweaveError
from stereoweave.matching import refine as refining
from stereoweave.matching import refine_kernels as kernels
from stereoweave.matching.matcher import Matcher
from stereoweave.matching.refine import NARROW, refine
from stereoweave.stereo import Estimate, StereoPair

FAR_PX, NEAR_PX, STICK_PX = 6, 16, 12
STICK = slice(60, 65)
MAPS = ("disparity_px", "right_disparity_px", "confidence", "occluded")
BLOCK = (slice(20, 50), slice(90, 120))
# Of 24x50 pixels. No other pixel of it is certain, so that paths begin at its four sides.
CERTAIN = (slice(4, 20), slice(10, 40))


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def photographs(rng, true_px, size):
    """Return a pair of noise with the disparities `true_px` of the right view, drawn from far to near."""
    height, width = size
    right = rng.integers(0, 256, (height, width, 3), np.uint8)
    left = rng.integers(0, 256, (height, width, 3), np.uint8)
    left_px = np.full(size, np.nan)
    for y in range(height):
        for x in np.argsort(true_px[y], kind="stable"):
            column = x + true_px[y, x]
            if 0 <= column < width:
                left[y, column], left_px[y, column] = right[y, x], true_px[y, x]
    return left, right, left_px


def estimate_of(disparity_px, right_disparity_px, confidence=0.2):
    return Estimate(
        disparity_px=disparity_px.astype(np.float32),
        right_disparity_px=right_disparity_px.astype(np.float32),
        confidence=np.full(disparity_px.shape, confidence, np.float32),
        occluded=np.zeros(disparity_px.shape, bool),
    )


@pytest.fixture
def scene(rng):
    """Return a stick and a block in front of a far wall: images and true disparities of both views."""
    right_px = np.full((64, 160), FAR_PX)
    right_px[:, STICK] = STICK_PX
    right_px[BLOCK] = NEAR_PX
    left, right, left_px = photographs(rng, right_px, right_px.shape)
    return left, right, left_px, right_px


def without_stick(left_px, right_px):
    return tuple(np.where(view == NEAR_PX, NEAR_PX, FAR_PX) for view in (left_px, right_px))


def test_a_stick_that_the_network_missed_comes_back_in_both_views(scene):
    left, right, left_px, right_px = scene
    refined = refine(left, right, estimate_of(*without_stick(left_px, right_px)))
    stick = np.zeros(left_px.shape, bool)
    stick[:, STICK.start + STICK_PX : STICK.stop + STICK_PX] = True
    assert (abs(refined.disparity_px[stick] - STICK_PX) < 1).mean() > 0.95
    assert (abs(refined.right_disparity_px[:, STICK] - STICK_PX) < 1).mean() > 0.95


def test_certain_disparities_of_the_network_are_kept(scene):
    left, right, left_px, right_px = scene
    given = estimate_of(*without_stick(left_px, right_px), confidence=0.9)
    np.testing.assert_array_equal(refine(left, right, given).disparity_px, given.disparity_px)


def test_a_stick_is_found_in_the_right_view_where_its_network_is_certain_of_the_wall(rng):
    far_px, stick_px = 6, 26
    right_px = np.full((64, 160), far_px)
    right_px[:, STICK] = stick_px
    left, right, _ = photographs(rng, right_px, right_px.shape)
    confidence = np.full(right_px.shape, 0.95, np.float32)
    in_left = slice(STICK.start + stick_px, STICK.stop + stick_px)
    confidence[:, in_left] = 0.2
    wall_px = np.full(right_px.shape, far_px)
    wall_px[:10, 120:140] = stick_px  # so that the range holds both
    given = Estimate(**vars(estimate_of(wall_px, wall_px)) | {"confidence": confidence})
    # What the right view's network is not certain of is more than 4 px from the stick.
    assert in_left.start - far_px - STICK.stop > 4
    refined = refine(left, right, given)
    assert (abs(refined.right_disparity_px[:, STICK] - stick_px) < 1).mean() > 0.95
    assert (abs(refined.disparity_px[:, in_left] - stick_px) < 1).mean() > 0.95


def test_the_right_view_is_searched_around_the_matches_of_newly_found_left_disparities():
    disparity_px = np.zeros((11, 20), np.float32)
    found_px = disparity_px.copy()
    found_px[5, 14] = 6  # it matches column 8
    found_px[5, 3] = 6  # it matches none
    found_px[2, 18] = 1  # too little
    expected = np.zeros((11, 20), bool)
    expected[1:10, 4:13] = True
    np.testing.assert_array_equal(refining.find_matches_of_found(disparity_px, found_px, 4), expected)


@pytest.mark.parametrize(("confidence", "share_found"), [(0.45, 0), (0.44, 0.95)])
def test_only_doubtful_disparities_are_replaced_without_a_wide_search(scene, confidence, share_found):
    left, right, left_px, right_px = scene
    given = estimate_of(*without_stick(left_px, right_px), confidence=confidence)
    found_px = refine(left, right, given, extent=NARROW).disparity_px
    in_left = slice(STICK.start + STICK_PX, STICK.stop + STICK_PX)
    assert (abs(found_px[:, in_left] - STICK_PX) < 1).mean() >= share_found
    if not share_found:
        np.testing.assert_array_equal(found_px, given.disparity_px)


def test_a_matcher_searches_what_is_doubtful_without_being_asked(scene):
    left, right, left_px, right_px = scene
    pair, given = StereoPair(left=left, right=right), estimate_of(*without_stick(left_px, right_px))
    found_px = Matcher("small").finish(pair, given).disparity_px
    in_left = slice(STICK.start + STICK_PX, STICK.stop + STICK_PX)
    assert (abs(found_px[:, in_left] - STICK_PX) < 1).mean() > 0.95


def test_a_wide_search_covers_all_that_may_be_replaced():
    assert refining.WIDE.confidence == kernels.CERTAIN


def test_an_outlier_far_beyond_the_picture_does_not_widen_the_search_to_it(scene):
    left, right, left_px, right_px = scene
    given = estimate_of(np.where(np.isnan(left_px), FAR_PX, left_px), right_px)
    given.disparity_px[0, 0] = 1e6
    found = refine(left, right, given, extent=NARROW)
    assert (abs(found.disparity_px - given.disparity_px)[2:, 20:] < 1).mean() > 0.99


def test_pixels_up_to_2_px_from_doubtful_ones_are_searched():
    confidence = np.full((9, 12), 0.5, np.float32)
    confidence[4, 6] = 0.44
    expected = np.zeros((9, 12), bool)
    expected[2:7, 4:9] = True
    found = refining.find_searched(np.zeros((9, 12)), confidence, -1, NARROW)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("towards", [-1, 1])
def test_pixels_whose_match_is_more_than_2_px_outside_the_other_picture_are_not_searched(towards):
    confidence = np.zeros((9, 30), np.float32)
    found = refining.find_searched(np.full((9, 30), 10, np.float32), confidence, towards, NARROW)
    # Of the left view, those up to column 7; but pixels up to 2 px from a searched one are searched too.
    np.testing.assert_array_equal(found[:, ::-towards], np.tile(np.arange(30) >= 6, (9, 1)))


def test_a_disparity_below_zero_may_lead_outside_the_other_side():
    confidence = np.zeros((5, 30), np.float32)
    found = refining.find_searched(np.full((5, 30), -10, np.float32), confidence, -1, NARROW)
    np.testing.assert_array_equal(found, np.tile(np.arange(30) <= 23, (5, 1)))


def test_correct_disparities_do_not_change_by_a_bit(scene):
    left, right, left_px, right_px = scene
    given = estimate_of(np.where(np.isnan(left_px), FAR_PX, left_px) + 0.3, right_px + 0.3, confidence=0.8)
    refined = refine(left, right, given)
    inner = np.isfinite(left_px) & (np.arange(160) >= NEAR_PX)
    # In noise, one pixel in several thousand finds a better match elsewhere.
    assert (refined.disparity_px == given.disparity_px)[inner].mean() > 0.999


def test_pixels_beyond_the_other_picture_continue_the_surface_beside_them(scene):
    left, right, left_px, right_px = scene
    wrong_px = np.where(np.arange(160) < FAR_PX, 1, FAR_PX) * np.ones((64, 1))
    refined = refine(left, right, estimate_of(wrong_px, right_px))
    np.testing.assert_allclose(refined.disparity_px[:, :FAR_PX], FAR_PX, atol=1)


def test_disparities_far_from_that_surface_are_kept(scene):
    left, right, left_px, right_px = scene
    near_px = np.where(np.arange(160) < FAR_PX, FAR_PX + 30, FAR_PX) * np.ones((64, 1))
    refined = refine(left, right, estimate_of(near_px, right_px))
    assert (refined.disparity_px[:, 0] == FAR_PX + 30).all()


def test_pixels_behind_a_nearer_surface_are_occluded(scene):
    left, right, left_px, right_px = scene
    refined = refine(left, right, estimate_of(*without_stick(left_px, right_px)))
    hidden = slice(STICK.start + FAR_PX, STICK.stop + FAR_PX)  # the part of the wall that the stick occludes
    assert refined.occluded[:, hidden].mean() > 0.9
    assert refined.occluded[:, 30:60].mean() < 0.02


def test_disparities_behind_the_plane_of_convergence_are_found_alike(rng):
    right_px = np.full((48, 120), 13)
    right_px[:, 50:55] = 19
    left, right, _ = photographs(rng, right_px, right_px.shape)
    flat_px = np.full(right_px.shape, 13.0)
    flat_px[10:20, 20:40] = 19  # so that the range holds both
    there = refine(left, right, estimate_of(flat_px, flat_px))
    moved = refine(left, np.roll(right, 20, 1), estimate_of(flat_px - 20, np.roll(flat_px, 20, 1) - 20))
    inner = (slice(None), slice(40, 90))
    np.testing.assert_allclose(moved.disparity_px[inner], there.disparity_px[inner] - 20, atol=1e-4)
    assert (there.disparity_px[:, 69:74] > 18).mean() > 0.9


def test_parallel_cameras_get_no_negative_disparities(rng):
    # The network's least disparity is 0, and a plain sky would take any candidate.
    photo = np.full((48, 120, 3), 200, np.uint8)
    photo[20:30, 40:80] = rng.integers(0, 256, (10, 40, 3), dtype=np.uint8)
    flat_px = np.zeros((48, 120))
    found = refine(photo, photo, estimate_of(flat_px, flat_px))
    assert found.disparity_px.min() >= 0
    assert found.right_disparity_px.min() >= 0


def test_confidence_rises_to_0_7_where_both_views_agree_on_texture(rng):
    size = (64, 160)
    left, right, _ = photographs(rng, np.full(size, FAR_PX), size)
    plain = slice(50, 110)
    left[:, plain] = right[:, plain.start - FAR_PX : plain.stop - FAR_PX] = 100
    given = estimate_of(np.full(size, FAR_PX), np.full(size, FAR_PX))
    given.confidence[:, 20:30] = 0.9
    given.confidence[:, 130:140] = 0
    refined = refine(left, right, given)
    np.testing.assert_array_equal(refined.confidence[:, :FAR_PX], np.float32(0.2))  # only one view sees it
    np.testing.assert_array_equal(refined.confidence[:, 8:20], np.float32(0.7))
    np.testing.assert_array_equal(refined.confidence[:, 20:30], np.float32(0.9))
    np.testing.assert_array_equal(refined.confidence[:, 55:105], np.float32(0.2))
    np.testing.assert_array_equal(refined.confidence[:, 115:130], np.float32(0.7))
    np.testing.assert_array_equal(refined.confidence[:, 130:140], np.float32(0))  # without content


def test_confidence_stays_where_the_pictures_differ_and_falls_where_they_hardly_match():
    columns, rows = np.arange(240), np.arange(48)[:, None]
    left = np.where(columns // 3 % 2, 140, 100) + 0 * rows
    sign = np.where((columns + columns // 4 + rows + rows // 4) % 2, 1, -1)
    right = left.copy()
    # Means of three columns are 100, 113, 127 and 140; their span over five, the contrast, is 27 or 40.
    right[:, 80:96] += 20 * sign[:, 80:96]  # 17 levels after equalisation: above 40 % of 40, below 80 % of 27
    right[:, 160:176] += 40 * sign[:, 160:176]  # 35 levels: above 80 % of 40
    images = (np.repeat(image[..., None], 3, 2).astype(np.uint8) for image in (left, right))
    refined = refine(*images, estimate_of(*np.zeros((2, 48, 240)), confidence=0.6), extent=NARROW)
    for first, end, confidence in (
        (0, 75, 0.7),
        (84, 92, 0.6),
        (100, 155, 0.7),
        (164, 172, 0.42),
        (180, 240, 0.7),
    ):
        np.testing.assert_allclose(refined.confidence[:, first:end], confidence, atol=1e-6)


def random_pair(rng, width=50):
    """Return random images and a random estimate, which exercise every branch; a block in it is certain."""
    left, right = (cv2.blur(rng.integers(0, 256, (24, width, 3), np.uint8), (3, 3)) for _ in range(2))
    maps = [np.repeat(rng.uniform(-3, 9, (24, 10)), 5, 1)[:, :width] for _ in range(2)]
    given, confidence = estimate_of(*maps), rng.random((24, width), np.float32)
    confidence[CERTAIN] = 0.9
    return left, right, Estimate(**vars(given) | {"confidence": confidence})


@pytest.mark.parametrize(("width", "in_colour"), [(50, True), (50, False), (49, True)])
def test_the_kernels_equal_the_plain_ones(rng, width, in_colour):
    left, right, given = random_pair(rng, width)
    if not in_colour:
        left, right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right))
    first_px, count = refining._candidates(given.disparity_px, given.right_disparity_px)
    own = refining._cues(left, given.disparity_px, first_px, given.confidence)
    right_trust = refining.right_confidence(given)
    other = refining._cues(right, given.right_disparity_px, first_px, np.float32(0.7) * right_trust)
    for view in (own, other):
        np.testing.assert_array_equal(view.census, plain_census(view.grey))
    searched = np.ones((24, width), bool)
    searched[8:16, 14:36] = False  # 4 px and more inside the block
    np.testing.assert_array_equal(
        refining.find_searched(given.disparity_px, given.confidence, -1, refining.WIDE), searched
    )
    search, size = refining._lay_out(np.zeros((1, 2), np.int32), searched, count)
    costs = np.full(size, 255, np.uint8)
    kernels.match(own, refining._align(other, first_px, count, -1, 2), search, -1, count, 0, 24, costs)
    expected = plain_costs(own, other, first_px, count)
    np.testing.assert_array_equal(costs, expected[searched].ravel())
    found_px, _ = refining._match_views((left, right), given, refining.WIDE, right_trust, 1)
    expected_px = plain_pick(plain_sums(expected, own, searched), first_px)
    np.testing.assert_allclose(found_px[searched], expected_px[searched], atol=1e-5)
    np.testing.assert_allclose(found_px[~searched], given.disparity_px[~searched], atol=1 / 16)


def test_paths_overwrite_what_was_in_their_sums(rng):
    left, _, given = random_pair(rng)
    searched = np.ones((24, 50), bool)
    searched[8:16, 14:36] = False
    search, size = refining._lay_out(np.zeros((1, 2), np.int32), searched, 32)
    own = refining._cues(left, given.disparity_px, -4, given.confidence)
    costs, steps = rng.integers(0, 200, size, np.uint8), rng.integers(20, 60, (24, 50), np.uint8)
    clean, dirty = np.zeros(size, np.uint16), rng.integers(0, 65536, size, np.uint16)
    for sums in (clean, dirty):
        kernels.along_rows(costs, own, search, steps, 32, 0, 24, sums)
    np.testing.assert_array_equal(clean, dirty)


@pytest.mark.parametrize("moved_px", [0, -20])
def test_each_tile_searches_from_the_least_disparity_of_the_tiles_around(rng, moved_px):
    left, right = (cv2.blur(rng.integers(0, 256, (140, 300, 3), np.uint8), (3, 3)) for _ in range(2))
    maps_px = [np.repeat(rng.uniform(0, 9, (140, 60)), 5, 1) + moved_px for _ in range(2)]
    for view_px in maps_px:
        view_px[64:, 200:] += 50
    given = estimate_of(*maps_px)
    given.confidence[:, 120:140] = 0.9
    first_px, count = refining._candidates(given.disparity_px, given.right_disparity_px)
    right_trust = refining.right_confidence(given)
    own = refining._cues(left, given.disparity_px, first_px, given.confidence)
    other = refining._cues(right, given.right_disparity_px, first_px, np.float32(0.7) * right_trust)
    searched = refining.find_searched(given.disparity_px, given.confidence, -1, refining.WIDE)
    costs = plain_costs(own, other, first_px, count)
    expected_px = plain_pick(plain_sums(costs, own, searched), first_px)
    found_px, _ = refining._match_views((left, right), given, refining.WIDE, right_trust, 2)
    np.testing.assert_allclose(found_px[searched], expected_px[searched], atol=1e-5)
    # The last tile row sees no disparity below 50 px, neither in its own tiles nor in those around.
    assert found_px[128:, 256:].min() > 30 + moved_px


def test_both_views_settle_as_the_plain_ones(rng):
    left, right, given = random_pair(rng)
    right_trust = refining.right_confidence(given)
    found_px = refining._match_views((left, right), given, refining.WIDE, right_trust, 1)
    refined = refine(left, right, given)
    expected = plain_settled(given.disparity_px, *found_px, given.confidence, -1)
    np.testing.assert_array_equal(refined.disparity_px, expected)
    expected = plain_settled(given.right_disparity_px, *found_px[::-1], np.float32(0.7) * right_trust, 1)
    np.testing.assert_array_equal(refined.right_disparity_px, expected)
    assert (refined.disparity_px != given.disparity_px).any()


def test_the_right_view_has_a_fifth_of_the_confidence_where_its_match_is_of_another_surface():
    given = estimate_of(np.array([[4, 4, 4, 2, 3]]), np.array([[2, 2, 0, 9, -9]]))
    given.confidence[0] = 0.1, 0.2, 0.3, 0.4, 0.5
    # The matches are in columns 2 (2 px off), 3 (alike), 2 (4 px off) and outside, beyond both borders.
    expected = np.float32([0.06, 0.4, 0.06, 0.1, 0.02])
    np.testing.assert_allclose(refining.right_confidence(given), expected[None])


def test_a_right_view_is_matched_as_the_left_one_of_the_mirrored_pair(scene, monkeypatch):
    # What makes the two views differ: the right one is coarser, and is searched after the left one.
    monkeypatch.setattr(refining, "_COARSE", np.float32(1))
    monkeypatch.setattr(refining, "find_matches_of_found", lambda _, found_px, __: found_px < -1e9)
    left, right, _, right_px = scene
    given = estimate_of(right_px, right_px, confidence=0)
    trust = np.zeros(right_px.shape, np.float32)
    trust[10:30, 30:100] = 0.9
    given = Estimate(**vars(given) | {"confidence": trust})
    found_px, right_found_px = refining._match_views((left, right), given, refining.WIDE, trust, 1)
    turned = {name: values[:, ::-1].copy() for name, values in vars(given).items() if name in MAPS}
    images = right[:, ::-1].copy(), left[:, ::-1].copy()
    mirrored_px, right_mirrored_px = refining._match_views(
        images, Estimate(**vars(given) | turned), refining.WIDE, trust[:, ::-1].copy(), 1
    )
    np.testing.assert_array_equal(mirrored_px[:, ::-1], right_found_px)
    np.testing.assert_array_equal(right_mirrored_px[:, ::-1], found_px)
    assert (abs(right_found_px - right_px) < 1).mean() > 0.9


def test_a_brighter_right_photograph_changes_little(scene):
    left, right, left_px, right_px = (np.tile(values, (2, 1, 1)[: values.ndim]) for values in scene)
    left, right = (80 + photo // 4 for photo in (left, right))
    given = estimate_of(*without_stick(left_px, right_px), confidence=0.6)
    brighter = np.rint(1.3 * right).astype(np.uint8)
    alike, different = (refine(left, photo, given) for photo in (right, brighter))
    for side in ("disparity_px", "right_disparity_px"):
        apart_px = abs(getattr(alike, side) - getattr(different, side))
        assert (apart_px > 1).mean() < 0.01
    assert (abs(different.right_disparity_px[:, STICK] - STICK_PX) < 1).mean() > 0.95


def test_a_right_view_settles_as_a_mirrored_left_one(rng):
    found_px, other_px, disparity_px = rng.integers(2, 5, (3, 30, 40)).astype(np.float32)
    disparity_px += 30 * (rng.random((30, 40)) < 0.2)
    trust = rng.random((30, 40), np.float32)
    right_px = refining._settle(disparity_px, found_px, other_px, trust, 1)
    np.testing.assert_array_equal(right_px, plain_settled(disparity_px, found_px, other_px, trust, 1))
    mirrored = (np.ascontiguousarray(values[:, ::-1]) for values in (disparity_px, found_px, other_px, trust))
    np.testing.assert_array_equal(refining._settle(*mirrored, -1)[:, ::-1], right_px)


def test_the_number_of_threads_changes_nothing(scene):
    left, right, left_px, right_px = scene
    given = estimate_of(*without_stick(left_px, right_px))
    one, three = (refine(left, right, given, threads=threads) for threads in (1, 3))
    np.testing.assert_array_equal(one.disparity_px, three.disparity_px)
    np.testing.assert_array_equal(one.right_disparity_px, three.right_disparity_px)


def test_strips_of_rows_find_what_the_whole_finds(rng, monkeypatch):
    right_px = np.full((200, 100), FAR_PX)
    right_px[:, 40:43] = STICK_PX
    left, right, _ = photographs(rng, right_px, right_px.shape)
    given = estimate_of(np.full((200, 100), FAR_PX), np.full((200, 100), FAR_PX))
    whole = refine(left, right, given)
    monkeypatch.setattr(refining, "_CANDIDATES_AT_ONCE", 1)
    strips = refine(left, right, given)
    assert (abs(whole.disparity_px - strips.disparity_px) > 0.5).mean() < 0.002


def test_an_estimate_of_other_photographs_is_refused(scene):
    left, right, _, right_px = scene
    given = estimate_of(right_px, right_px)
    with pytest.raises(StereoweaveError, match="expected the size of the images, 159x64, got 160x64"):
        refine(left[:, 1:], right[:, 1:], given)
