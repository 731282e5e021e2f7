from pathlib import Path

import cv2
import numpy as np
import pytest

from stereoweave.cameras.feature_matches import find_matches
from stereoweave.io.images import read_image

LEFT = Path(__file__).resolve().parents[1] / "textured_pair/left.png"


@pytest.fixture(scope="module")
def photo():
    return read_image(LEFT)


def moved(photo, across_px, down_px):
    """The photograph moved right and down."""
    shift = np.array([[1.0, 0, across_px], [0, 1, down_px]])
    return cv2.warpAffine(photo, shift, photo.shape[1::-1], flags=cv2.INTER_CUBIC)


def test_a_moved_photograph_matches_itself_to_a_tenth_of_a_pixel(photo):
    found = find_matches(photo, moved(photo, -20.3, 5.6))
    assert len(found.left_px) > 200
    assert np.median(np.abs(found.disparity_px - 20.3)) < 0.1
    assert np.median(np.abs(found.lower_px - 5.6)) < 0.1


def test_another_exposure_matches_as_exactly(photo):
    dark = (moved(photo, -20.3, 0) * 0.4 + 10).astype(np.uint8)
    found = find_matches(photo, dark)
    assert np.median(np.abs(found.disparity_px - 20.3)) < 0.1


def test_a_turned_photograph_is_matched_where_the_turn_brings_it(photo):
    height, width = photo.shape[:2]
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), 5, 1)
    found = find_matches(photo, cv2.warpAffine(photo, turn, (width, height), flags=cv2.INTER_CUBIC))
    expected = found.left_px @ turn[:, :2].T + turn[:, 2]
    assert np.median(np.linalg.norm(found.right_px - expected, axis=1)) < 0.3


def test_large_pictures_are_matched_in_their_own_pixels(photo):
    large = cv2.resize(photo, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    found = find_matches(large, moved(large, -82, 3), most=500)
    assert np.median(np.abs(found.disparity_px - 82)) < 0.2
    assert np.median(np.abs(found.lower_px - 3)) < 0.2


def test_plain_pictures_have_no_matches():
    plain = np.full((64, 96, 3), 90, np.uint8)
    found = find_matches(plain, plain)
    assert found.left_px.shape == found.right_px.shape == (0, 2)


def test_the_smallest_pictures_are_matched(rng):
    noise = rng.integers(0, 256, (32, 32, 3), np.uint8)
    found = find_matches(noise, noise)
    np.testing.assert_allclose(found.left_px, found.right_px, atol=1e-3)
