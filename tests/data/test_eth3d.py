import numpy as np
import pytest
from dataset_examples import cut, error_naming, names, read_frame, shades, write_map, write_picture

from stereoweave.stereo import StereoCamera

CALIBRATION = """\
cam0=[541.764 0 553.869; 0 541.764 232.396; 0 0 1]
cam1=[541.764 0 553.869; 0 541.764 232.396; 0 0 1]
doffs=0
baseline=59.9101
width=40
height=32
ndisp=64
"""
FILES = [f"two_view_training/forest_1s/{name}" for name in ("im0.png", "im1.png", "calib.txt")] + [
    f"two_view_training_gt/forest_1s/{name}" for name in ("disp0GT.pfm", "mask0nocc.png")
]


@pytest.fixture
def root(tmp_path):
    for scene in ("delivery_area_1l", "forest_1s"):
        pictures, truth = tmp_path / "two_view_training" / scene, tmp_path / "two_view_training_gt" / scene
        write_picture(pictures / "im0.png", 10)
        write_picture(pictures / "im1.png", 20)
        (pictures / "calib.txt").write_text(CALIBRATION)
        write_map(truth / "disp0GT.pfm", [7.25, 3.5, np.inf], 2, np.float32)
        write_map(truth / "mask0nocc.png", [255, 128, 0], 255, np.uint8)
    return tmp_path


def test_frames_are_the_scenes_by_name(root):
    assert names("eth3d", root) == ["delivery_area_1l", "forest_1s"]
    assert shades(read_frame("eth3d", root, "forest_1s")) == (10, 20)


def test_disparity_is_a_pfm_where_infinity_is_unknown(root):
    sample = read_frame("eth3d", root, "forest_1s")
    np.testing.assert_array_equal(sample.disparity_px[0, :4], [7.25, 3.5, np.nan, 2])
    assert np.isnan(sample.right_disparity_px).all()


def test_known_pixels_that_only_one_camera_sees_are_occluded(root):
    sample = read_frame("eth3d", root, "forest_1s")
    assert np.argwhere(sample.occluded).tolist() == [[0, 1]]
    assert not sample.right_occluded.any()


def test_the_camera_is_that_of_calib_txt(root):
    expected = StereoCamera(focal_px=541.764, baseline_m=0.0599101, cx_px=553.869, cy_px=232.396)
    assert read_frame("eth3d", root, "forest_1s").camera == expected


@pytest.mark.parametrize("file", FILES)
def test_a_missing_file_is_named(root, file):
    (root / file).unlink()
    error_naming(root / file, "eth3d", root)


@pytest.mark.parametrize("file", FILES)
def test_a_truncated_file_is_named(root, file):
    cut(root / file)
    error_naming(root / file, "eth3d", root)


@pytest.mark.parametrize("folder", ["two_view_training", "two_view_training_gt"])
def test_a_missing_folder_is_named(root, folder):
    (root / folder).rename(root / "elsewhere")
    error_naming(root / folder, "eth3d", root)


@pytest.mark.parametrize("file", FILES[3:])
def test_ground_truth_of_another_size_is_named(root, file):
    write_map(root / file, [], 1, np.float32 if file.endswith(".pfm") else np.uint8, shape=(32, 41))
    assert "41x32" in error_naming(root / file, "eth3d", root)


def test_a_mask_in_colour_is_named(root):
    write_map(root / FILES[4], [], (255, 255, 255), np.uint8)
    assert "mode RGB" in error_naming(root / FILES[4], "eth3d", root)
