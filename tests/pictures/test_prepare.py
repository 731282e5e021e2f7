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
