from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereoweave.cameras.diagnosis import find_problems
from stereoweave.errors import Remedy
from stereoweave.io.images import read_image, read_pair
from stereoweave.learn.data.collage import paint_collage
from stereoweave.matching.matcher import Matcher
from stereoweave.stereo import Estimate, StereoCamera, StereoPair

TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"


@pytest.fixture(scope="module")
def example():
    return read_pair(TEXTURED / "left.png", TEXTURED / "right.png")


def estimate_of(pair, confidence) -> Estimate:
    """Return an estimate with the given confidence, a single value or a map."""
    size = pair.left.shape[:2]
    return Estimate(
        disparity_px=np.full(size, 20, np.float32),
        right_disparity_px=np.full(size, 20, np.float32),
        confidence=np.broadcast_to(np.float32(confidence), size),
        occluded=np.zeros(size, bool),
    )


def plain_pair(width=200, **masks) -> StereoPair:
    return StereoPair(
        left=np.zeros((40, width, 3), np.uint8), right=np.zeros((40, width, 3), np.uint8), **masks
    )


def test_a_sound_pair_of_which_the_network_is_sure_gets_no_line(example):
    assert find_problems(example, estimate_of(example, 0.9)) == []


def test_swapped_sides_are_reported(example):
    swapped = StereoPair(left=example.right, right=example.left)
    assert list(map(str, find_problems(swapped, estimate_of(swapped, 0.9)))) == [
        "left and right are swapped; give them the other way round"
    ]


def test_a_pair_that_is_not_rectified_gets_one_note(example):
    lower = StereoPair(
        left=np.ascontiguousarray(example.left[:-2]), right=np.ascontiguousarray(example.right[2:])
    )
    (line,) = find_problems(lower, estimate_of(lower, 0.1))
    assert str(line) == "the right picture is 2.0 px higher than the left one; rectify the pair (rectify)"


def test_after_a_rectification_the_remedy_is_another_one(example):
    lower = StereoPair(
        left=np.ascontiguousarray(example.left[:-2]), right=np.ascontiguousarray(example.right[2:])
    )
    calibrate = Remedy("give a calibration", ("calibration",))
    (line,) = find_problems(lower, estimate_of(lower, 0.9), remedy=calibrate)
    assert str(line).endswith("than the left one; give a calibration (calibration)")
    (line,) = find_problems(plain_pair(), estimate_of(plain_pair(), 0.1), remedy=calibrate)
    assert str(line).endswith("not be rectified; give a calibration (calibration)")


def test_negative_disparities_by_themselves_are_no_reason_for_a_line(example):
    left, right = (np.ascontiguousarray(x) for x in (example.left[:, 20:], example.right[:, :-20]))
    converged = StereoPair(left=left, right=right)
    assert find_problems(converged, estimate_of(converged, 0.9)) == []


def test_a_camera_that_puts_many_points_beyond_infinity_gets_a_line(example):
    camera = StereoCamera(focal_px=600.0, baseline_m=0.1, cx_px=310.0, cy_px=240.0)
    left, right = (np.ascontiguousarray(x) for x in (example.left[:, 30:], example.right[:, :-30]))
    converged = StereoPair(left=left, right=right, camera=camera)
    (line,) = find_problems(converged, estimate_of(converged, 0.9))
    assert str(line).startswith("depths in metres are wrong: ")
    assert str(line).endswith("put beyond infinity; give a calibration with doffs (calibration)")
    complete = replace(converged, camera=replace(camera, doffs_px=30.0))
    assert find_problems(complete, estimate_of(complete, 0.9)) == []
    parallel = replace(example, camera=camera)
    assert find_problems(parallel, estimate_of(parallel, 0.9)) == []


def test_low_confidence_nearly_everywhere_is_reported():
    (line,) = find_problems(plain_pair(), estimate_of(plain_pair(), 0.1))
    assert str(line).startswith("only 0 % of the disparities are confident")
    assert find_problems(plain_pair(), estimate_of(plain_pair(), 0.9)) == []


def test_pixels_without_content_need_no_confidence():
    seen = np.zeros((40, 200), bool)
    seen[:, :50] = True
    confidence = np.where(seen, 0.9, 0)
    assert find_problems(plain_pair(left_seen=seen), estimate_of(plain_pair(), confidence)) == []
    (line,) = find_problems(plain_pair(), estimate_of(plain_pair(), confidence))
    assert str(line).startswith("only 25 %")


def test_pictures_of_two_scenes_are_named(example):
    other = paint_collage(77, 0, 2, *example.left.shape[:2]).right
    unrelated = StereoPair(left=example.left, right=other)
    (line,) = find_problems(unrelated, estimate_of(unrelated, 0.1))
    assert "different scenes" in str(line)


@pytest.mark.testdata
def test_no_real_pair_gets_a_line(testdata):
    matcher = Matcher("small", threads=1)
    folders = sorted(left.parent for left in (testdata / "stereo").glob("*/*/left.png"))
    assert len(folders) == 15
    for folder in folders[::3]:
        pair = StereoPair(left=read_image(folder / "left.png"), right=read_image(folder / "right.png"))
        assert find_problems(pair, matcher.estimate(pair.left, pair.right)) == [], folder


def notes_on_camera(pair, focal_px, baseline_m):
    camera = StereoCamera.centred(pair.left, focal_px=focal_px, baseline_m=baseline_m)
    found = find_problems(replace(pair, camera=camera), estimate_of(pair, 0.9))
    return [str(note) for note in found]


@pytest.mark.parametrize(
    ("baseline_m", "apart"),
    [(193.0, "193.0 m"), (5.5, "5.5 m"), (0.000193, "0.19 mm"), (0.00099, "0.99 mm")],
)
def test_a_baseline_in_a_wrong_unit_is_noted(example, baseline_m, apart):
    assert notes_on_camera(example, 600.0, baseline_m) == [
        f"unlikely depths in metres: the cameras are {apart} apart; "
        "check the unit of the baseline (calibration, baseline_m)"
    ]


def test_a_focal_length_in_millimetres_is_noted(example):
    assert example.left.shape[1] == 640
    # 320 px are 9.143 times 35 px, and the angle whose tangent is 9.143 is 83.76 degrees.
    assert notes_on_camera(example, 35.0, 0.1) == [
        "unlikely depths in metres: a focal length of 35 px means a field of view of 168 degrees; "
        "check that the focal length is in pixels (calibration, focal_px)"
    ]


# A window of 150 degrees, the widest of a VR180 picture, has 320 / tan(75 degrees) = 85.7 px.
@pytest.mark.parametrize(("focal_px", "baseline_m"), [(85.7, 0.002), (5000.0, 4.0)])
def test_a_wide_lens_and_a_long_rig_are_not_doubted(example, focal_px, baseline_m):
    assert notes_on_camera(example, focal_px, baseline_m) == []
