from pathlib import Path

import cv2
import numpy as np
import pytest

from stereoweave.cameras.alignment import DEFECTS, check_pair
from stereoweave.cameras.auto_align import align
from stereoweave.errors import StereoweaveError
from stereoweave.io.images import read_image, read_pair
from stereoweave.learn.data.collage import paint_collage
from stereoweave.stereo import StereoPair

TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"
SEED = 77
# Painted pairs whose images have the same exposure.
ALIKE = 2, 6


def turned(photo, degrees, scale=1.0):
    """The photograph turned clockwise and scaled about its middle."""
    height, width = photo.shape[:2]
    turn = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), -degrees, scale)
    return cv2.warpAffine(photo, turn, (width, height), borderMode=cv2.BORDER_REPLICATE)


def brighter(photo, stops):
    return np.clip(255 * (2.0**stops * (photo / 255) ** 2.2) ** (1 / 2.2), 0, 255).astype(np.uint8)


def cut(photo, rows=slice(None), columns=slice(None)):
    return np.ascontiguousarray(photo[rows, columns])


ONE_DEFECT = {
    "swapped": lambda left, right: (right, left),
    "vertical_shift": lambda left, right: (cut(left, slice(2, None)), cut(right, slice(-2))),
    "rotation": lambda left, right: (left, turned(right, 1)),
    "scale": lambda left, right: (left, turned(right, 0, scale=1.02)),
    "exposure": lambda left, right: (left, brighter(right, -1)),
}


@pytest.fixture(scope="module")
def pairs():
    """Return the example pair, followed by painted pairs."""
    example = read_pair(TEXTURED / "left.png", TEXTURED / "right.png")
    painted = [paint_collage(SEED, 0, index, 480, 640) for index in ALIKE]
    return [(pair.left, pair.right) for pair in (example, *painted)]


def test_sound_pairs_have_no_defect(pairs):
    assert [check_pair(*pair).defects for pair in pairs] == [()] * len(pairs)


@pytest.mark.parametrize("defect", ONE_DEFECT)
def test_each_simulated_defect_is_the_one_reported(pairs, defect):
    for pair in pairs:
        assert check_pair(*ONE_DEFECT[defect](*pair)).defects == (defect,)


def test_far_objects_at_negative_disparities_are_reported(pairs):
    for left, right in pairs:
        least_px = check_pair(left, right).range_px[0]
        columns = round(least_px) + 8
        found = check_pair(cut(left, columns=slice(columns, None)), cut(right, columns=slice(-columns)))
        assert found.defects == ("negative_disparity",)
        assert found.range_px[0] == pytest.approx(-8, abs=2)
        assert found.warnings() == []


def test_measured_amounts_equal_the_simulated_ones(pairs):
    left, right = pairs[0]
    lower = check_pair(*ONE_DEFECT["vertical_shift"](left, right))
    assert lower.vertical_shift_px == pytest.approx(2, abs=0.3)
    assert lower.vertical_error_px == pytest.approx(2, abs=0.3)
    assert check_pair(left, turned(right, 1)).rotation_degrees == pytest.approx(1, abs=0.1)
    assert check_pair(left, turned(right, -1)).rotation_degrees == pytest.approx(-1, abs=0.1)
    assert check_pair(left, turned(right, 0, scale=1.03)).scale == pytest.approx(1.03, abs=0.002)
    assert check_pair(left, turned(right, 0, scale=0.97)).scale == pytest.approx(0.97, abs=0.002)
    assert check_pair(left, brighter(right, -1)).exposure_ratio == pytest.approx(0.5, rel=0.1)
    assert check_pair(left, right).exposure_ratio == pytest.approx(1, rel=0.1)


def test_the_lines_say_what_to_do(pairs):
    left, right = pairs[0]
    lower = check_pair(*ONE_DEFECT["vertical_shift"](left, right))
    assert str(lower.lines()[-1]) == (
        "the right picture is 2.0 px lower than the left one; rectify the pair (rectify)"
    )
    assert lower.warnings() == lower.lines()[-1:]
    assert str(check_pair(left, turned(right, -1)).lines()[-1]) == (
        "the right picture is rotated 1.0 degrees anticlockwise; rectify the pair (rectify)"
    )
    assert str(check_pair(*ONE_DEFECT["scale"](left, right)).lines()[-1]) == (
        "the right picture is 2.0 % larger than the left one; rectify the pair (rectify)"
    )
    assert "2.0 times the exposure of the other" in str(check_pair(left, brighter(right, -1)).lines()[-1])
    assert str(check_pair(right, left).lines()[-1]).startswith("left and right are swapped")
    assert str(check_pair(left, right).lines()[-1]).startswith("no defects")


def test_convergence_is_named_as_rows_that_do_not_match(pairs):
    left, right = pairs[0]
    height, width = left.shape[:2]
    camera = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
    turn = camera @ cv2.Rodrigues(np.array([0, 0.08, 0]))[0] @ np.linalg.inv(camera)
    toed_in = cv2.warpPerspective(right, turn, (width, height), borderMode=cv2.BORDER_REPLICATE)
    assert "not_rectified" in check_pair(left, toed_in).defects


def test_pictures_of_two_scenes_and_plain_ones_are_told_apart(pairs):
    unrelated = check_pair(pairs[1][0], pairs[2][1])
    assert unrelated.defects == ("unrelated",)
    assert unrelated.lines() == unrelated.warnings()
    assert str(unrelated.lines()[0]).startswith("expected two pictures of the same scene, found ")
    assert str(unrelated.lines()[0]).endswith("; give the two pictures of one pair")
    assert "20 that are needed" in str(unrelated.lines()[0])
    plain = np.full((100, 200, 3), 90, np.uint8)
    found = check_pair(plain, plain)
    assert found.defects == ("too_few_matches",)
    assert str(found.lines()[0]).startswith(
        "expected pictures with more texture, found 0 matching points of the 20"
    )
    assert not (found.is_known or found.is_rectified)


def test_one_picture_given_twice_is_named(pairs):
    left, _ = pairs[0]
    noisy = np.clip(left + np.random.default_rng(0).normal(0, 3, left.shape), 0, 255).astype(np.uint8)
    for right in (left, noisy):
        found = check_pair(left, right)
        assert found.defects == ("same_picture",)
        assert str(found.warnings()[0]).startswith("left and right show the same view: ")
        assert str(found.warnings()[0]).endswith("; give two pictures from two positions")
    assert "all disparities are 0.0 px, so" in str(check_pair(left, left).warnings()[0])


def test_each_defect_has_a_note(pairs):
    found = check_pair(*pairs[0])
    assert all(len(str(found._note(defect))) > 20 for defect in DEFECTS)


@pytest.mark.testdata
def test_real_pairs_have_no_defect(testdata):
    folders = sorted(left.parent for left in (testdata / "stereo").glob("pairs/*/left.png"))
    assert len(folders) == 12
    for folder in folders[::4]:
        assert check_pair(read_image(folder / "left.png"), read_image(folder / "right.png")).defects == ()


@pytest.mark.parametrize("size", [(32, 32_000), (32_000, 32)])
def test_a_strip_of_a_picture_is_checked_like_any_other(rng, size):
    left = np.zeros((*size, 3), np.uint8)
    left[:1000, :1000] = rng.integers(0, 256, left[:1000, :1000].shape, dtype=np.uint8)
    assert set(check_pair(left, np.roll(left, -4, axis=1)).defects) <= set(DEFECTS)


def test_a_pair_turned_by_90_degrees_is_recognised():
    example = read_pair(TEXTURED / "left.png", TEXTURED / "right.png")
    left, right = (np.ascontiguousarray(np.rot90(image)) for image in (example.left, example.right))
    found = check_pair(left, right)
    assert found.defects == ("stacked",)
    assert not found.is_known
    (note,) = found.lines()
    assert str(note).endswith("both pictures are turned; rotate both pictures by 90 degrees")
    pair = StereoPair(left=left, right=right)
    assert align(pair).pair is pair
    with pytest.raises(StereoweaveError, match="one camera stood above the other"):
        align(pair, always=True)
