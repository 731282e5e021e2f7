import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereoweave.cameras.alignment import check_pair
from stereoweave.cameras.picture_warp import PictureWarp
from stereoweave.cameras.rectify_uncalibrated import rectify_by_features
from stereoweave.errors import StereoweaveError
from stereoweave.io.images import read_pair
from stereoweave.learn.data.collage import paint_collage
from stereoweave.stereo import StereoPair

TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"


def homography(size, degrees):
    """Return the homography of a camera rotation about three axes; the focal length is 0.9 widths."""
    width, height = size
    camera = np.array([[0.9 * width, 0, width / 2], [0, 0.9 * width, height / 2], [0, 0, 1]])
    return camera @ cv2.Rodrigues(np.radians(np.float64(degrees)))[0] @ np.linalg.inv(camera)


def turned(photo, degrees):
    size = photo.shape[1::-1]
    return cv2.warpPerspective(
        photo, homography(size, degrees), size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )


def sift_matches(left, right):
    """Return matched points, x and y in each picture, by OpenCV's SIFT, which rectification does not use."""
    sift = cv2.SIFT_create(500)
    (left_points, left_words), (right_points, right_words) = (
        sift.detectAndCompute(cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY), None) for photo in (left, right)
    )
    best = [
        first
        for first, second in cv2.BFMatcher().knnMatch(left_words, right_words, k=2)
        if first.distance < 0.7 * second.distance
    ]
    return (
        np.array([left_points[match.queryIdx].pt for match in best]),
        np.array([right_points[match.trainIdx].pt for match in best]),
    )


@pytest.fixture(scope="module")
def example():
    return read_pair(TEXTURED / "left.png", TEXTURED / "right.png")


@pytest.fixture(scope="module")
def mended(example):
    return rectify_by_features(StereoPair(left=example.left, right=turned(example.right, (2, -3, 3))))


@pytest.mark.parametrize("degrees", [(3, -3, 2), (-3, 3, -2)])
def test_pairs_turned_by_up_to_three_degrees_end_under_half_a_pixel(degrees):
    made = paint_collage(77, 0, 2, 480, 640)
    both = StereoPair(left=turned(made.left, (-1, 3, -1)), right=turned(made.right, degrees))
    left_px, right_px = sift_matches(both.left, both.right)
    assert np.median(np.abs(left_px - right_px)[:, 1]) > 3
    rectified = rectify_by_features(both).pair
    left_px, right_px = sift_matches(rectified.left, rectified.right)
    assert len(left_px) > 100
    assert np.median(np.abs(left_px - right_px)[:, 1]) < 0.5
    assert np.percentile(left_px[:, 0] - right_px[:, 0], 5) > -1


def test_a_mended_pair_is_sound_and_of_the_same_size(example, mended):
    assert mended.pair.left.shape == example.left.shape
    assert check_pair(mended.pair.left, mended.pair.right).defects == ()
    assert mended.pair.camera is None
    assert mended.notes[0].text.startswith("rectified: rows are off by 0.")


def test_pixels_outside_the_source_are_masked_and_repeat_the_border(mended):
    seen = mended.pair.right_seen
    assert 0.8 < seen.mean() < 1
    # A black border would be darker than everything in the picture.
    assert mended.pair.right[~seen].mean() > mended.pair.right[seen].mean() / 2


@pytest.mark.parametrize(("zoom", "text"), [(1.03, "made 2.9 % smaller"), (0.97, "made 3.1 % larger")])
def test_the_note_says_how_the_size_was_changed(example, zoom, text):
    size = example.left.shape[1::-1]
    zoomed = cv2.getRotationMatrix2D((size[0] / 2, size[1] / 2), 0, zoom)
    right = cv2.warpAffine(example.right, zoomed, size, borderMode=cv2.BORDER_REPLICATE)
    (note,) = rectify_by_features(StereoPair(left=example.left, right=right)).notes
    assert f"the right picture was {text}" in note.text


def test_the_note_says_how_far_the_corners_moved_as_distortion_was_removed(example):
    warp = PictureWarp(homography=np.eye(3), distortion=0.15, size_px=example.left.shape[1::-1])
    left, right = (warp.apply(image, None)[0] for image in (example.left, example.right))
    (note,) = rectify_by_features(StereoPair(left=left, right=right)).notes
    # A distortion of -0.15 moves the corners, 400 px from the centre, by about 0.15 / 0.85 * 400 = 71 px.
    (by_px,) = re.findall("distortion was removed, which moved the corners by ([0-9]+) px", note.text)
    assert 50 < int(by_px) < 100


def test_a_sound_pair_stays_nearly_what_it_is(example):
    rectified = rectify_by_features(example).pair
    assert rectified.left_seen.mean() > 0.95
    left_px, moved_px = sift_matches(example.left, rectified.left)
    assert np.percentile(np.linalg.norm(left_px - moved_px, axis=1), 90) < 3


def test_an_existing_mask_is_warped_with_its_picture(example):
    seen = np.ones(example.left.shape[:2], bool)
    seen[:, :40] = False
    masked = StereoPair(left=example.left, right=example.right, left_seen=seen)
    rectified_seen = rectify_by_features(masked).pair.left_seen
    assert not rectified_seen[:, :30].any()
    assert rectified_seen[20:-20, 60:-60].all()


def test_the_same_pair_gives_the_same_result(example):
    first, second = (rectify_by_features(example) for _ in range(2))
    np.testing.assert_array_equal(first.pair.right, second.pair.right)


def test_plain_pictures_and_two_scenes_are_refused(example):
    plain = np.full((100, 200, 3), 90, np.uint8)
    other = paint_collage(77, 0, 2, *example.left.shape[:2]).right
    for pair in (StereoPair(left=plain, right=plain), StereoPair(left=example.left, right=other)):
        with pytest.raises(
            StereoweaveError, match=r"^rectify: expected at least 40 .* matches .*, found \d+ of"
        ):
            rectify_by_features(pair)


def test_a_camera_that_moved_forward_is_refused(example):
    size = example.left.shape[1::-1]
    zoomed = cv2.getRotationMatrix2D((size[0] / 2, size[1] / 2), 0, 1.08)
    forward = StereoPair(left=example.left, right=cv2.warpAffine(example.left, zoomed, size))
    with pytest.raises(StereoweaveError, match=r"side by side, .* a scale difference of \+8%; take"):
        rectify_by_features(forward)
