"""`stereoweave.estimate` with alignment; tests of matching itself are in tests/matching/test_estimate.py."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

import stereoweave as sw
from stereoweave.cameras.calibration_files import read_rig, write_rig
from stereoweave.cameras.rig import Optics, Rig
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


def test_two_files_are_opened_with_their_notes_as_the_command_opens_them(example, estimate, tmp_path):
    paths = [tmp_path / "left.png", tmp_path / "right.png"]
    right_side_up = Image.Exif()
    right_side_up[0x0112] = 3  # the camera hung upside down
    for path, view, tags in zip(
        paths, (example.left, example.right), (right_side_up, Image.Exif()), strict=True
    ):
        Image.fromarray(view[::-1, ::-1]).save(path, exif=tags)
    found = sw.estimate(*paths)
    assert "the only EXIF orientation" in str(found.notes[0])
    np.testing.assert_array_equal(found.disparity_px, estimate.disparity_px)
    np.testing.assert_array_equal(sw.render(*paths, found, 0.0).image, example.left)


def test_files_of_twelve_bits_in_sixteen_are_noted(example, tmp_path):
    paths = [tmp_path / "left.png", tmp_path / "right.png"]
    for path, view in zip(paths, (example.left, example.right), strict=True):
        Image.fromarray(view[..., 0].astype(np.uint16) * 16).save(path)
    notes = sw.estimate(*paths).notes
    assert [str(note).partition(": 16 bits")[0] for note in notes] == [
        "left picture: nearly black",
        "right picture: nearly black",
    ]


def test_a_note_advises_what_the_function_can_do(example):
    # Only a small window has texture, with fewer matches than rectification needs.
    left, right = np.full((2, *example.left.shape), 90, np.uint8)
    left[200:290, 200:290] = example.left[200:290, 200:290]
    right[200 - DOWN_PX : 290 - DOWN_PX, 180:270] = example.right[200:290, 180:270]
    failed, _ = map(str, sw.estimate(left, right, align="auto").notes)
    assert failed.startswith("the pair could not be rectified: expected at least 40 feature matches")
    assert failed.endswith("with more texture and with more overlap; or give a calibration (calibration)")


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


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 3), (40, 1), (31, 64)])
@pytest.mark.parametrize("align", [None, "auto"])
def test_an_image_of_less_than_32_pixels_is_refused(height, width, align):
    image = np.zeros((height, width, 3), np.uint8)
    with pytest.raises(StereoweaveError, match=rf"^images: expected at least 32x32 .+ {width}x{height}"):
        sw.estimate(image, image, align=align)


def write_rolled_rig(path, roll_degrees):
    """Write a calibration for 160x120 px: 0.1 m apart, the right camera rolled about its optical axis."""
    lens = Optics(matrix=np.array([[150.0, 0, 79.5], [0, 150, 59.5], [0, 0, 1]]), distortion=np.zeros(5))
    rotation = cv2.Rodrigues(np.array([0, 0, np.radians(roll_degrees)]))[0]
    towards_left_m = rotation @ np.array([-0.1, 0, 0])
    rig = Rig(left=lens, right=lens, rotation=rotation, translation_m=towards_left_m, size_px=(160, 120))
    write_rig(path, rig)


def test_a_calibration_gives_the_pair_its_camera(example, estimate):
    found = sw.estimate(example.left, example.right, calibration=EXAMPLES / "calib.txt")
    assert found.pair.camera == read_rig(EXAMPLES / "calib.txt").camera()
    np.testing.assert_array_equal(found.disparity_px, estimate.disparity_px)
    assert str(found.notes[-1]).endswith("calibration of rectified pictures, so they are left unchanged")


def test_a_pair_is_rectified_by_a_calibration_of_cameras_that_are_not_parallel(tmp_path):
    write_rolled_rig(tmp_path / "rig.yml", roll_degrees=2.0)
    grey = np.full((120, 160, 3), 128, np.uint8)
    found = sw.estimate(grey, grey, calibration=str(tmp_path / "rig.yml"))
    assert found.pair.right_seen is not None and not found.pair.right_seen.all()
    assert (found.confidence[~found.pair.left_seen] == 0).all()
    assert (found.pair.camera.focal_px, found.pair.camera.baseline_m) == pytest.approx((150, 0.1))
    assert any("rectified with" in str(note) for note in found.notes)


def test_a_calibration_for_another_size_or_besides_an_alignment_is_refused(example):
    half = example.left[::2, ::2], example.right[::2, ::2]
    with pytest.raises(StereoweaveError, match="calib.txt: .* 320x240"):
        sw.estimate(*half, calibration=EXAMPLES / "calib.txt")
    with pytest.raises(StereoweaveError, match="^calibration: expected either a calibration or align='auto'"):
        sw.estimate(example.left, example.right, calibration=EXAMPLES / "calib.txt", align="auto")
    with pytest.raises(StereoweaveError, match="^calibration: expected no calibration, which follows from"):
        sw.estimate(
            example.left, example.right, calibration=EXAMPLES / "calib.txt", projection="equirectangular"
        )


def test_the_layout_of_one_file_is_chosen_and_named_in_the_error_that_asks_for_it(example, tmp_path):
    write_image(tmp_path / "both.png", np.vstack([example.left, example.right]))
    chosen = sw.estimate(tmp_path / "both.png", format="top_bottom")
    np.testing.assert_array_equal(chosen.pair.right, example.right)
    with pytest.raises(StereoweaveError, match=r"choose its layout, such as side_by_side \(format\)$"):
        sw.estimate(EXAMPLES / "left.png")
    with pytest.raises(StereoweaveError, match="^format: expected none for two images"):
        sw.estimate(example.left, example.right, format="side_by_side")


def test_an_error_advises_nothing_that_the_function_cannot_do(tmp_path):
    (tmp_path / "film.mp4").write_bytes(b"\0\0\0\x18ftypisom\0\0\0\0isom" + bytes(200))
    with pytest.raises(StereoweaveError) as caught:
        sw.estimate(tmp_path / "film.mp4")
    assert "found a video" in str(caught.value) and "(video)" not in str(caught.value)


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
