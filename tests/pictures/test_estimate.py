"""`stereoweave.estimate` with alignment; tests of matching itself are in tests/matching/test_estimate.py."""

from pathlib import Path

import numpy as np
import pytest

import stereoweave as sw
from stereoweave.errors import StereoweaveError
from stereoweave.io.images import read_pair, write_image
from stereoweave.learn.data.collage import paint_collage

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
DOWN_PX = 12


@pytest.fixture(scope="module")
def example():
    return read_pair(EXAMPLES / "left.png", EXAMPLES / "right.png")


@pytest.fixture(scope="module")
def lower(example):
    """Return the example pair with a right image that is 12 px lower."""
    return example.left[:-DOWN_PX], example.right[DOWN_PX:]


@pytest.fixture(scope="module")
def estimate(example):
    return sw.estimate(example.left, example.right)


@pytest.fixture(scope="module")
def unaligned(lower):
    return sw.estimate(*lower)


@pytest.fixture(scope="module")
def aligned(lower):
    return sw.estimate(*lower, align="auto")


def test_a_pair_out_of_line_is_aligned_on_request(estimate, unaligned, aligned):
    found = aligned
    expected_px = estimate.disparity_px[:-DOWN_PX]
    sure = found.pair.left_seen & (found.confidence > 0.9)
    assert sure.mean() > 0.6
    # Where infinity is after alignment is unknown, so all disparities may be off by the same number.
    off_px = (found.disparity_px - expected_px)[sure]
    assert np.median(np.abs(off_px - np.median(off_px))) < 0.5
    unaligned_px = (unaligned.disparity_px - expected_px)[sure]
    assert np.median(np.abs(unaligned_px - np.median(unaligned_px))) > 2


def test_a_view_of_an_aligned_estimate_shows_the_aligned_pair(lower, aligned):
    view = sw.render(*lower, aligned, 0.0)
    np.testing.assert_array_equal(view.image, aligned.pair.left)


def test_the_estimate_says_how_the_pair_was_aligned(example, unaligned, aligned):
    (note,) = aligned.notes
    assert str(note).startswith("rectified: rows are off by ")
    assert "no_rectify" not in str(note)
    assert unaligned.notes == ()
    swapped = sw.estimate(example.right, example.left, align="auto")
    assert list(map(str, swapped.notes)) == ["left and right were swapped, and have been swapped back"]


def test_the_estimate_says_which_problems_remain(example):
    other = paint_collage(77, 0, 2, *example.left.shape[:2]).right
    (unrelated,) = sw.estimate(example.left, other, align="auto").notes
    assert "different scenes" in str(unrelated)
    (same,) = sw.estimate(example.left, example.left, align="auto").notes
    assert str(same).startswith("left and right show the same view")
    plain = np.full((64, 96, 3), 90, np.uint8)
    (doubtful,) = sw.estimate(plain, plain, align="auto").notes
    assert str(doubtful).endswith("not be rectified; give pictures that are rectified by a calibration")
    assert sw.estimate(example.left, example.left).notes == ()


def test_a_note_advises_nothing_that_the_function_cannot_do(example):
    # Only a small window has texture, with fewer matches than rectification needs.
    left, right = np.full((2, *example.left.shape), 90, np.uint8)
    left[200:290, 200:290] = example.left[200:290, 200:290]
    right[200 - DOWN_PX : 290 - DOWN_PX, 180:270] = example.right[200:290, 180:270]
    failed, _ = map(str, sw.estimate(left, right, align="auto").notes)
    assert failed.startswith("the pair could not be rectified: expected at least 40 feature matches")
    assert failed.endswith("photograph a scene with more texture and with more overlap")


@pytest.mark.usefixtures("without_shape_checks")
def test_a_direction_may_be_a_list_or_an_array(example):
    def look(direction):
        window = {"projection": "half_equirectangular", "look_deg": direction, "fov_deg": 60.0}
        return sw.estimate(example.left, example.right, **window).disparity_px

    expected_px = look((10.0, 5.0))
    for direction in ([10.0, 5.0], np.array([10.0, 5.0])):
        np.testing.assert_array_equal(look(direction), expected_px)
    with pytest.raises(
        StereoweaveError, match=r"^look_deg: expected yaw and pitch in degrees, got \[1, 2, 3\]"
    ):
        look([1, 2, 3])


def test_a_sound_pair_gives_the_same_with_and_without_alignment(example, estimate):
    aligned = sw.estimate(example.left, example.right, align="auto")
    assert aligned.pair is None
    assert aligned.notes == ()
    np.testing.assert_array_equal(aligned.disparity_px, estimate.disparity_px)


@pytest.mark.usefixtures("without_shape_checks")
def test_another_kind_of_alignment_is_refused(example):
    with pytest.raises(StereoweaveError, match="^align: expected 'auto' or None, got 'always'"):
        sw.estimate(example.left, example.right, align="always")


def test_one_file_with_both_views_is_a_pair(example, estimate, tmp_path):
    both = tmp_path / "both.png"
    write_image(both, np.hstack([example.left, example.right]))
    found = sw.estimate(both)
    np.testing.assert_array_equal(found.disparity_px, estimate.disparity_px)
    np.testing.assert_array_equal(found.pair.right, example.right)
    assert found.pair.camera is None
    assert [str(note).partition(",")[0] for note in found.notes] == ["side_by_side"]


@pytest.mark.testdata
def test_a_spatial_photo_alone_gives_metres(testdata):
    found = sw.estimate(testdata / "consumer" / "vision-pro.HEIC", align="auto")
    depth_m = found.pair.camera.depth_m(found.disparity_px)
    # The yellow pillow in the middle: its pattern at column 1310 is 135 px farther left in the right picture,
    # 1525.4 px * 63.774 mm / 135 px = 0.721 m.
    assert np.median(depth_m[1340:1400, 1280:1340]) == pytest.approx(0.721, abs=0.01)


@pytest.mark.usefixtures("without_shape_checks")
def test_an_image_alone_is_no_pair(example):
    with pytest.raises(StereoweaveError) as caught:
        sw.estimate(example.left)
    assert str(caught.value) == (
        "right: expected a right image besides a left one that is no path, found None; "
        "give it, or the path of one file with both views"
    )
