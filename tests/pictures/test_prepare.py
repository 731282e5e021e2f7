"""The camera of a prepared pair; opening is tested in test_loading.py, rectification in tests/cameras."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stereoweave.cameras.alignment import check_pair
from stereoweave.io.images import read_image
from stereoweave.pictures.prepare import Request, prepare

TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"
BY_PX = 30
NO_DOFFS = (
    " % of the matches have negative disparities, as from converged cameras, whose doffs are not in "
    "metadata; give a calibration with doffs (calibration)"
)


def write_photo(path, by_px):
    """Write an MPO file by a camera that names itself, with all disparities smaller by `by_px`."""
    left, right = (read_image(TEXTURED / f"{eye}.png") for eye in ("left", "right"))
    left, right = left[:, by_px:], right[:, : right.shape[1] - by_px]
    tags = Image.Exif()
    tags[0x0110] = "FinePix REAL 3D W3"  # its baseline is known
    tags.get_ifd(0x8769)[0xA405] = 35  # the focal length on film in mm
    first, second = (Image.fromarray(np.ascontiguousarray(image)) for image in (left, right))
    first.save(path, "MPO", save_all=True, append_images=[second], quality=97, exif=tags.tobytes())
    return path


@pytest.mark.parametrize("rectify", [None, False, True])
def test_a_camera_from_exif_is_dropped_if_many_disparities_are_negative(rectify, tmp_path):
    prepared = prepare([write_photo(tmp_path / "a.mpo", BY_PX)], Request(rectify=rectify))
    assert prepared.pair.camera is None
    (note,) = (str(note) for note in prepared.notes if note.text.startswith("no depth in metres: "))
    assert note.endswith(NO_DOFFS)


@pytest.mark.parametrize("rectify", [None, False])
def test_a_camera_from_exif_is_kept_if_no_disparity_is_negative(rectify, tmp_path):
    prepared = prepare([write_photo(tmp_path / "a.mpo", 0)], Request(rectify=rectify))
    assert prepared.pair.camera.baseline_m == 0.075
    assert not [note for note in prepared.notes if "metres" in note.text]


def test_a_camera_given_by_the_user_is_kept(tmp_path):
    request = Request(focal_px=600.0)
    assert prepare([write_photo(tmp_path / "a.mpo", BY_PX)], request).pair.camera.focal_px == 600.0


@pytest.mark.testdata
def test_a_converged_lens_gives_no_metres(testdata):
    prepared = prepare([testdata / "consumer" / "Panasonic-DMC-GX8.mpo"], Request())
    assert prepared.pair.camera is None
    assert str(prepared.notes[-1]) == "no depth in metres: 82" + NO_DOFFS


@pytest.mark.testdata
def test_a_pair_of_a_vr180_camera_is_aligned(testdata):
    prepared = prepare([testdata / "consumer" / "calf-left-right.jpg"], Request())
    assert str(prepared.notes[0]).startswith("side_by_side, detected")
    assert prepared.pair.left.shape == (1080, 1920, 3)
    # The rows of the file are 2.6 px apart.
    found = check_pair(prepared.pair.left, prepared.pair.right)
    assert found.vertical_error_px < 0.3 and found.vertical_error_95_px < 1 and not found.defects


def notes_on(**camera):
    pictures = [TEXTURED / "left.png", TEXTURED / "right.png"]
    return [str(note) for note in prepare(pictures, Request(**camera)).notes]


@pytest.mark.parametrize(
    ("baseline_m", "apart"), [(193.0, "193 m"), (5.5, "5.5 m"), (0.000193, "0.19 mm"), (0.0009, "0.9 mm")]
)
def test_a_baseline_in_a_wrong_unit_is_noted(baseline_m, apart):
    assert notes_on(focal_px=600.0, baseline_m=baseline_m) == [
        f"unlikely depths in metres: the cameras are {apart} apart; "
        "check the unit of the baseline (calibration, baseline_m)"
    ]


def test_a_focal_length_in_millimetres_is_noted():
    assert read_image(TEXTURED / "left.png").shape[1] == 640
    # 320 px are 9.143 times 35 px, and the angle whose tangent is 9.143 is 83.76 degrees.
    assert notes_on(focal_px=35.0, baseline_m=0.1) == [
        "unlikely depths in metres: a focal length of 35 px means a field of view of 168 degrees; "
        "check that the focal length is in pixels (calibration, focal_px)"
    ]


@pytest.mark.parametrize(("focal_px", "baseline_m"), [(150.0, 0.002), (5000.0, 4.0)])
def test_a_wide_lens_and_a_long_rig_are_not_doubted(focal_px, baseline_m):
    assert notes_on(focal_px=focal_px, baseline_m=baseline_m) == []


def test_a_calibration_in_a_wrong_unit_is_noted(tmp_path):
    calibration = tmp_path / "calib.txt"
    camera = "[600 0 320; 0 600 240; 0 0 1]"
    calibration.write_text(f"cam0={camera}\ncam1={camera}\ndoffs=0\nbaseline=0.193\nwidth=640\nheight=480\n")
    (note,) = notes_on(calibration=calibration)
    assert note.startswith("unlikely depths in metres: the cameras are 0.19 mm apart")
