"""The vote at depth edges: against its plain reference, on edges worked out by hand, and on a network."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from plain_voting import plain_vote

from stereoweave.bench.edge_metrics import flying_percent
from stereoweave.io.images import read_pair
from stereoweave.learn.data.collage import paint_collage
from stereoweave.matching.edge_vote.vote import sharpen_edges, vote_at_edges
from stereoweave.matching.edge_vote.vote_kernels import vote
from stereoweave.matching.matcher import Matcher
from stereoweave.stereo import Estimate

TEXTURED = Path(__file__).resolve().parents[2] / "textured_pair"


def estimate_of(disparity_px, confidence=0.9):
    disparity_px = np.asarray(disparity_px, np.float32)
    return Estimate(
        disparity_px=disparity_px,
        right_disparity_px=disparity_px.copy(),
        confidence=np.full(disparity_px.shape, confidence, np.float32),
        occluded=np.zeros(disparity_px.shape, bool),
    )


@pytest.fixture
def red_before_blue():
    """Return an image whose left half is red and whose right half is blue."""
    image = np.zeros((40, 60, 3), np.uint8)
    image[:, :30], image[:, 30:] = (200, 30, 30), (30, 30, 200)
    return image


def test_the_kernel_agrees_with_its_plain_reference(rng):
    lab = (100 * rng.random((20, 30, 3))).astype(np.float32).round(-1)
    disparity_px, confidence = ((scale * rng.random((20, 30))).astype(np.float32) for scale in (50, 1))
    sound = rng.random((20, 30)) > 0.5
    sound[:12, :12] = False
    voted_px, agreement, unsound = disparity_px.copy(), np.full((20, 30), np.nan, np.float32), ~sound
    vote(lab, disparity_px, confidence, sound, voted_px, agreement, unsound, 0, 20)
    expected_px, agreed, still_unsound = plain_vote(lab.astype(float), disparity_px, confidence, sound)
    np.testing.assert_array_equal(voted_px, expected_px)
    np.testing.assert_allclose(agreement, agreed, rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(unsound, still_unsound)
    assert unsound.any()


def test_a_disparity_between_two_surfaces_takes_that_of_its_colour(red_before_blue):
    disparity_px = np.full((40, 60), 20.0)
    disparity_px[:, 30:] = 5
    disparity_px[:, 28:32] = [17, 14, 11, 8]
    expected_px = np.where(np.arange(60) < 30, 20.0, 5.0)
    found = vote_at_edges(red_before_blue, estimate_of(disparity_px))
    np.testing.assert_array_equal(found.disparity_px, np.broadcast_to(expected_px, (40, 60)))


def test_a_speckle_disappears_and_a_large_object_stays(red_before_blue):
    disparity_px = np.full((40, 60), 20.0)
    disparity_px[5:9, 5:9] = 50
    disparity_px[15:35, 5:25] = 30
    found_px = vote_at_edges(red_before_blue, estimate_of(disparity_px)).disparity_px
    np.testing.assert_array_equal(found_px[5:9, 5:9], 20)
    np.testing.assert_array_equal(found_px[18:32, 8:22], 30)


@pytest.mark.parametrize(("confidence", "expected_px"), [(0.4, 20), (0.6, 50)])
def test_a_larger_speckle_disappears_where_it_is_doubted(red_before_blue, confidence, expected_px):
    estimate = estimate_of(np.full((40, 60), 20.0))
    estimate.disparity_px[10:26, 5:21] = 50
    estimate.confidence[10:26, 5:21] = confidence
    found_px = vote_at_edges(red_before_blue, estimate).disparity_px
    np.testing.assert_array_equal(found_px[12:24, 7:19], expected_px)


def test_a_plain_surface_is_filled_to_its_middle(rng):
    estimate = estimate_of(np.full((130, 130), 20.0))
    estimate.disparity_px[10:120, 10:120] = 60 * rng.random((110, 110))
    estimate.confidence[10:120, 10:120] = 0
    found = vote_at_edges(np.full((130, 130, 3), 90, np.uint8), estimate)
    np.testing.assert_array_equal(found.disparity_px, 20)
    np.testing.assert_array_equal(found.confidence[10:120, 10:120], 0)


@pytest.fixture
def unsure_area():
    """Return an estimate of confidence 0.9, with an area of confidence 0.1 that is 1.5 px nearer."""
    estimate = estimate_of(np.full((40, 60), 20.0))
    estimate.disparity_px[10:20, 5:20] = 21.5
    estimate.confidence[10:20, 5:20] = 0.1
    return estimate


def test_an_unsure_area_takes_the_disparity_around_it(red_before_blue, unsure_area):
    np.testing.assert_array_equal(vote_at_edges(red_before_blue, unsure_area).disparity_px, 20)


def test_the_confidence_of_a_replaced_disparity_follows_from_its_neighbours(red_before_blue, unsure_area):
    confidence = vote_at_edges(red_before_blue, unsure_area).confidence
    # All neighbours of the corner that vote have confidence 0.9 and agree; it had 0.1 itself.
    assert confidence[10, 5] == pytest.approx(0.29 + 0.32 * 0.9 + 0.25 * 0.1)
    # The area's middle is filled from what was filled.
    assert 0.29 < confidence[15, 12] < confidence[10, 5] - 0.05


def test_a_replaced_disparity_that_one_camera_sees_is_less_confident(red_before_blue, unsure_area):
    unsure_area.occluded[10:20, 5:20] = True
    confidence = vote_at_edges(red_before_blue, unsure_area).confidence
    assert confidence[10, 5] == pytest.approx(0.18 + 0.32 * 0.9 + 0.25 * 0.1)


def test_neighbours_that_disagree_lower_the_confidence(red_before_blue):
    disparity_px = np.where(np.arange(60) < 30, 20.0, 5.0) * np.ones((40, 1))
    at_edge = vote_at_edges(red_before_blue, estimate_of(disparity_px)).confidence[20, 29]
    within_red = vote_at_edges(red_before_blue, estimate_of(np.roll(disparity_px, -15, 1))).confidence[20, 14]
    assert at_edge == pytest.approx(0.29 + 0.57 * 0.9)
    # The pixel's own side has between half and two thirds of the weight.
    assert 0.29 + 0.25 * 0.9 + 0.32 * 0.9 / 2 < within_red < 0.29 + 0.25 * 0.9 + 0.32 * 0.9 * 2 / 3


def test_a_disparity_that_is_kept_loses_a_quarter_of_its_doubt(red_before_blue):
    confidence = vote_at_edges(red_before_blue, estimate_of(np.full((40, 60), 20.0), 0.6)).confidence
    np.testing.assert_allclose(confidence, 0.7, rtol=1e-6)


def test_what_is_replaced_where_the_image_is_plain_keeps_confidence_0(red_before_blue, unsure_area):
    unsure_area.confidence[10:20, 5:20] = 0
    found = vote_at_edges(red_before_blue, unsure_area)
    np.testing.assert_array_equal(found.disparity_px, 20)
    np.testing.assert_array_equal(found.confidence[10:20, 5:20], 0)


def test_sound_disparities_do_not_change(red_before_blue, rng):
    slanted_px = np.add.outer(np.zeros(40), np.linspace(10, 20, 60)) + 0.2 * rng.random((40, 60))
    estimate = estimate_of(slanted_px)
    np.testing.assert_array_equal(
        vote_at_edges(red_before_blue, estimate).disparity_px, estimate.disparity_px
    )


def test_the_result_does_not_depend_on_the_number_of_threads():
    pair = read_pair(TEXTURED / "left.png", TEXTURED / "right.png")
    estimate = Matcher("small", threads=1).estimate(pair.left, pair.right)
    one, three = (vote_at_edges(pair.left, estimate, threads) for threads in (1, 3))
    np.testing.assert_array_equal(one.disparity_px, three.disparity_px)


def test_fewer_pixels_fly_at_the_edges_of_a_painted_pair():
    sample = paint_collage(77, 0, 2, 240, 320)
    network = Matcher("small", threads=1).estimate(sample.left, sample.right)
    before, after = (
        flying_percent(estimate.disparity_px, sample.disparity_px)
        for estimate in (network, vote_at_edges(sample.left, network))
    )
    assert after < 0.85 * before


def test_an_image_of_one_colour_is_no_obstacle():
    grey = np.full((32, 32, 3), 90, np.uint8)
    noise_px = cv2.GaussianBlur(np.random.default_rng(0).random((32, 32)).astype(np.float32) * 40, (0, 0), 1)
    found = vote_at_edges(grey, estimate_of(noise_px))
    assert np.isfinite(found.disparity_px).all()


def thin_bars():
    """Return a blue image with a lighter bar 2 px wide, and disparities of it and of a bar that it lacks."""
    image, disparity_px = np.zeros((40, 60, 3), np.uint8), np.full((40, 60), 5.0)
    image[:] = (30, 30, 200)
    image[:, 15:17] = (60, 60, 200)  # 27 grey levels lighter
    disparity_px[:, 15:17] = disparity_px[:, 40:42] = 20
    return image, disparity_px


def test_sharp_edges_lie_on_those_of_the_image_and_confidences_do_not_change(red_before_blue):
    disparity_px = np.full((40, 60), 20.0)
    disparity_px[:, 30:] = 5
    disparity_px[:, 28:32] = [17, 14, 11, 8]
    estimate = estimate_of(disparity_px, confidence=0.7)
    found = sharpen_edges(red_before_blue, estimate)
    expected_px = np.where(np.arange(60) < 30, 20.0, 5.0)
    np.testing.assert_array_equal(found.disparity_px, np.broadcast_to(expected_px, (40, 60)))
    np.testing.assert_array_equal(found.confidence, estimate.confidence)
    np.testing.assert_array_equal(found.right_disparity_px, estimate.right_disparity_px)


@pytest.mark.parametrize(("confidence", "is_kept"), [(0.9, True), (0.1, False)])
def test_a_thin_thing_stays_sharp_if_the_image_shows_it_and_it_is_not_unsure(confidence, is_kept):
    image, disparity_px = thin_bars()
    expected_px = np.full((40, 60), 5.0)
    expected_px[:, 15:17] = 20 if is_kept else 5
    found_px = sharpen_edges(image, estimate_of(disparity_px, confidence)).disparity_px
    np.testing.assert_array_equal(found_px, expected_px)


def test_a_flat_speckle_is_no_edge_to_sharpen(red_before_blue):
    disparity_px = np.full((40, 60), 20.0)
    disparity_px[10:14, 10:14] = 22  # a step of less than 3 px, which `vote_at_edges` removes
    estimate = estimate_of(disparity_px)
    np.testing.assert_array_equal(sharpen_edges(red_before_blue, estimate).disparity_px, disparity_px)
    assert (vote_at_edges(red_before_blue, estimate).disparity_px == 20).all()
