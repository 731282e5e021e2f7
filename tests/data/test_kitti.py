import os

import numpy as np
import pytest
from dataset_examples import cut, error_naming, names, read_frame, shades, write_map, write_picture

from stereoweave.data.readers import read_scenes
from stereoweave.stereo import StereoCamera

# Rounded values of a real drive; the colour cameras are beside the grey ones.
PROJECTIONS = {0: (600, 0), 1: (600, -378), 2: (600, 42), 3: (601, -336)}
LAYOUTS = {
    "kitti2012": ("image_0", "image_1", "disp_occ", "disp_noc", "calib", "P{}"),
    "kitti2015": ("image_2", "image_3", "disp_occ_0", "disp_noc_0", "calib_cam_to_cam", "P_rect_0{}"),
}
PATHS = [
    (dataset, f"{folder}/000001_10.png") for dataset, folders in LAYOUTS.items() for folder in folders[:4]
]


def write_dataset(root, dataset):
    left, right, occ, noc, calib, key = LAYOUTS[dataset]
    training = root / "training"
    for number in ("000000", "000001"):
        # _11 is the next time step, which has no ground truth.
        for moment in ("10", "11"):
            write_picture(training / left / f"{number}_{moment}.png", 10)
            write_picture(training / right / f"{number}_{moment}.png", 20)
        write_map(training / occ / f"{number}_10.png", [256, 1, 0, 1921], 0, np.uint16)
        write_map(training / noc / f"{number}_10.png", [256, 0, 0, 1921], 0, np.uint16)
        (training / calib).mkdir(exist_ok=True)
        lines = [
            f"{key.format(i)}: 700 0 {cx_px} {shift} 0 700 180 0 0 0 1 0.0027\n"
            for i, (cx_px, shift) in PROJECTIONS.items()
        ]
        text = "calib_time: 09-Jan-2012 13:57:47\n" + "".join(lines)
        (training / calib / f"{number}.txt").write_text(text)
    return root


@pytest.fixture(params=LAYOUTS)
def dataset(request, tmp_path):
    write_dataset(tmp_path, request.param)
    return request.param


def test_frames_are_the_first_moments_by_name(dataset, tmp_path):
    assert names(dataset, tmp_path) == ["000000_10", "000001_10"]


def test_the_pictures_are_left_and_right(dataset, tmp_path):
    assert shades(read_frame(dataset, tmp_path, "000001_10")) == (10, 20)


def test_disparity_is_256ths_of_a_pixel_and_0_is_unknown(dataset, tmp_path):
    sample = read_frame(dataset, tmp_path, "000001_10")
    np.testing.assert_array_equal(sample.disparity_px[0, :4], [1, 1 / 256, np.nan, 7.50390625])
    assert np.isnan(sample.disparity_px[1:]).all()
    assert np.isnan(sample.right_disparity_px).all()


def test_pixels_known_only_in_the_occluded_map_are_occluded(dataset, tmp_path):
    sample = read_frame(dataset, tmp_path, "000001_10")
    assert np.argwhere(sample.occluded).tolist() == [[0, 1]]
    assert not sample.right_occluded.any()
    _, scene = read_scenes(tmp_path, dataset)
    assert np.argwhere(scene.occluded).tolist() == [[0, 1]]


def test_the_disparity_of_the_next_moment_is_not_taken_for_the_right_view_s(tmp_path):
    write_dataset(tmp_path, "kitti2015")
    write_map(tmp_path / "training" / "disp_occ_1" / "000000_10.png", [], 512, np.uint16)
    assert np.isnan(read_frame("kitti2015", tmp_path, "000000_10").right_disparity_px).all()


def test_the_camera_comes_from_the_two_projections(tmp_path):
    write_dataset(tmp_path / "2012", "kitti2012")
    write_dataset(tmp_path / "2015", "kitti2015")
    # 2012: (0 - -378) / 700; 2015: (42 - -336) / 700, and the right principal point is one pixel farther
    # right.
    grey = StereoCamera(focal_px=700, baseline_m=0.54, cx_px=600, cy_px=180)
    colour = StereoCamera(focal_px=700, baseline_m=0.54, cx_px=600, cy_px=180, doffs_px=1)
    assert read_frame("kitti2012", tmp_path / "2012", "000000_10").camera == grey
    assert read_frame("kitti2015", tmp_path / "2015", "000000_10").camera == colour


@pytest.mark.parametrize(("dataset_name", "file"), PATHS)
def test_a_missing_file_is_named(tmp_path, dataset_name, file):
    write_dataset(tmp_path, dataset_name)
    (tmp_path / "training" / file).unlink()
    error_naming(tmp_path / "training" / file, dataset_name, tmp_path)


@pytest.mark.parametrize(("dataset_name", "file"), PATHS)
def test_a_truncated_file_is_named(tmp_path, dataset_name, file):
    write_dataset(tmp_path, dataset_name)
    cut(tmp_path / "training" / file)
    error_naming(tmp_path / "training" / file, dataset_name, tmp_path)


@pytest.mark.parametrize("index", range(5))
def test_a_missing_folder_is_named(dataset, tmp_path, index):
    folder = tmp_path / "training" / LAYOUTS[dataset][index]
    folder.rename(tmp_path / "elsewhere")
    error_naming(folder, dataset, tmp_path)


def test_a_missing_calibration_is_named(dataset, tmp_path):
    path = tmp_path / "training" / LAYOUTS[dataset][4] / "000001.txt"
    path.unlink()
    error_naming(path, dataset, tmp_path)


@pytest.mark.parametrize("text", ["", "P0: 700\nP1: 700\nP_rect_02: 1 2\n", "P0 P1"])
def test_a_calibration_without_its_projections_is_named(dataset, tmp_path, text):
    path = tmp_path / "training" / LAYOUTS[dataset][4] / "000001.txt"
    path.write_text(text)
    assert "12 numbers" in error_naming(path, dataset, tmp_path)


def test_a_calibration_of_words_is_named(dataset, tmp_path):
    path = tmp_path / "training" / LAYOUTS[dataset][4] / "000001.txt"
    path.write_text(path.read_text().replace("700", "far"))
    error_naming(path, dataset, tmp_path)


def test_a_calibration_that_is_too_large_or_a_pipe_is_named(dataset, tmp_path):
    path = tmp_path / "training" / LAYOUTS[dataset][4] / "000001.txt"
    path.write_text(path.read_text() + " " * 300_000)
    assert "found more" in error_naming(path, dataset, tmp_path)
    path.unlink()
    os.mkfifo(path)
    assert "found a pipe" in error_naming(path, dataset, tmp_path)


@pytest.mark.parametrize("index", [2, 3])
def test_a_disparity_of_8_bits_or_of_another_size_is_named(dataset, tmp_path, index):
    path = tmp_path / "training" / LAYOUTS[dataset][index] / "000001_10.png"
    write_map(path, [], 9, np.uint8)
    assert "mode L" in error_naming(path, dataset, tmp_path)
    write_map(path, [], 9, np.uint16, shape=(32, 41))
    assert "41x32" in error_naming(path, dataset, tmp_path)
