import shutil

import numpy as np
import pytest
from dataset_examples import cut, error_naming, names, read_frame, shades, write_map, write_picture

from stereoweave.data.readers import open_dataset
from stereoweave.stereo import StereoCamera

# f B = 30 px m
CALIBRATION = "cam0=[300 0 19.5; 0 300 15.5; 0 0 1]\ndoffs=0\nbaseline=100\nwidth=40\nheight=32\n"
FRAMES = ["mill/0001", "propeller/0001", "propeller/0002"]


@pytest.fixture
def root(tmp_path):
    for frame in FRAMES:
        write_picture(tmp_path / "left" / f"{frame}.png", 10)
        write_picture(tmp_path / "right" / f"{frame}.png", 20)
        write_map(tmp_path / "depth" / f"{frame}.png", [0, 1500, 15000, 15001, 65535], 6000, np.uint16)
    (tmp_path / "calib.txt").write_text(CALIBRATION)
    return tmp_path


def test_frames_are_the_equal_names_of_the_three_folders(root):
    assert names("paper", root) == FRAMES
    assert shades(read_frame("paper", root, "propeller/0002")) == (10, 20)


def test_depth_in_millimetres_becomes_disparity_through_the_camera(root):
    sample = read_frame("paper", root, "mill/0001")
    # 30 / 1.5, 30 / 15 and 30 / 6; 0 and what is beyond 15 m are unknown.
    np.testing.assert_allclose(sample.disparity_px[0, :6], [np.nan, 20, 2, np.nan, np.nan, 5], rtol=1e-6)
    assert np.isnan(sample.right_disparity_px).all()


def test_depth_packed_in_rgb_is_a_number_of_24_bits_lowest_byte_in_red(root):
    start = [(0, 0, 0), (255, 255, 255), (254, 255, 255), (0, 0, 128), (0, 64, 0)]
    write_map(root / "depth" / "mill" / "0001.png", start, (0, 0, 64), np.uint8)
    sample = read_frame("paper", root, "mill/0001")
    # The largest known number is 15 m; 2^23, 2^14 and 2^22 are about a half, a 1024th and a quarter of it.
    expected = [np.nan, np.nan, 2, 4, 2048, 8]
    np.testing.assert_allclose(sample.disparity_px[0, :6], expected, rtol=1e-6)


def test_the_camera_is_one_for_all(root):
    expected = StereoCamera(focal_px=300, baseline_m=0.1, cx_px=19.5, cy_px=15.5)
    assert {read_frame("paper", root, name).camera for name in FRAMES} == {expected}


def test_disparity_leads_back_to_the_depth(root):
    sample = read_frame("paper", root, "mill/0001")
    np.testing.assert_allclose(sample.camera.depth_m(sample.disparity_px)[0, 1:3], [1.5, 15], rtol=1e-6)


def test_pixels_beside_the_right_picture_are_occluded(root):
    sample = read_frame("paper", root, "mill/0001")
    assert np.argwhere(sample.occluded[1]).ravel().tolist() == [0, 1, 2, 3, 4]
    assert not sample.right_occluded.any()


def test_files_without_subfolders_are_one_sequence(root):
    for folder in ("left", "right", "depth"):
        (root / folder).rename(root / "scenes")
        (root / "scenes" / "propeller").rename(root / folder)
        shutil.rmtree(root / "scenes")
    frames = open_dataset("paper", root)
    assert [(frame.sequence, frame.name) for frame in frames] == [("", "0001"), ("", "0002")]


@pytest.mark.parametrize("folder", ["left", "right", "depth"])
def test_a_missing_or_truncated_file_is_named(root, folder):
    path = root / folder / "propeller" / "0002.png"
    cut(path)
    error_naming(path, "paper", root)
    path.unlink()
    error_naming(path, "paper", root)


@pytest.mark.parametrize("folder", ["left", "right", "depth"])
def test_a_missing_folder_is_named(root, folder):
    (root / folder).rename(root / "elsewhere")
    error_naming(root / folder, "paper", root)


def test_a_missing_calibration_is_named(root):
    (root / "calib.txt").unlink()
    error_naming(root / "calib.txt", "paper", root)


def test_a_calibration_for_another_size_is_named(root):
    (root / "calib.txt").write_text(CALIBRATION.replace("width=40", "width=80"))
    assert "80x32" in error_naming(root / "calib.txt", "paper", root)


def test_depth_of_8_bits_or_of_another_size_is_named(root):
    path = root / "depth" / "propeller" / "0002.png"
    write_map(path, [], 9, np.uint8)
    assert "mode L" in error_naming(path, "paper", root)
    write_map(path, [], 9, np.uint16, shape=(32, 41))
    assert "41x32" in error_naming(path, "paper", root)
