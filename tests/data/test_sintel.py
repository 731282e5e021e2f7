import struct

import numpy as np
import pytest
from dataset_examples import cut, error_naming, names, read_frame, shades, write_map, write_picture

from stereoweave.stereo import StereoCamera

SHADES = {"clean_left": 10, "clean_right": 20, "final_left": 30, "final_right": 40}


@pytest.fixture
def root(tmp_path):
    for sequence, count in (("alley_1", 2), ("ambush_2", 1)):
        for frame in (f"{sequence}/frame_{i + 1:04d}.png" for i in range(count)):
            for folder, shade in SHADES.items():
                write_picture(tmp_path / "training" / folder / frame, shade)
            disparity = tmp_path / "training" / "disparities" / frame
            write_map(disparity, [(3, 96, 0), (0, 0, 64), (255, 255, 0)], (0, 128, 0), np.uint8)
            write_map(tmp_path / "training" / "occlusions" / frame, [0, 255, 0], 0, np.uint8)
            write_map(tmp_path / "training" / "outofframe" / frame, [0, 0, 255], 0, np.uint8)
    return tmp_path


def write_camera(root, frame, tag=202021.25, extra=b""):
    path = root / "training" / "camdata_left" / f"{frame}.cam"
    path.parent.mkdir(parents=True, exist_ok=True)
    intrinsics = (1120.0, 0, 511.5, 0, 1120.0, 217.5, 0, 0, 1)
    path.write_bytes(struct.pack("<f21d", tag, *intrinsics, *range(12)) + extra)
    return path


def test_frames_are_of_both_passes_and_by_name(root):
    assert names("sintel", root) == [
        "clean/alley_1/frame_0001",
        "clean/alley_1/frame_0002",
        "clean/ambush_2/frame_0001",
        "final/alley_1/frame_0001",
        "final/alley_1/frame_0002",
        "final/ambush_2/frame_0001",
    ]


@pytest.mark.parametrize(("kind", "expected"), [("clean", (10, 20)), ("final", (30, 40))])
def test_each_pass_has_its_own_pictures(root, kind, expected):
    assert shades(read_frame("sintel", root, f"{kind}/alley_1/frame_0002")) == expected


def test_disparity_is_packed_in_red_green_and_blue(root):
    sample = read_frame("sintel", root, "clean/alley_1/frame_0001")
    # 3 * 4 + 96 / 64; 64 / 16384; 255 * 4 + 255 / 64; and 128 / 64 everywhere else.
    np.testing.assert_array_equal(sample.disparity_px[0, :4], [13.5, 0.00390625, 1023.984375, 2.0])
    assert sample.disparity_px.dtype == np.float32
    assert np.isnan(sample.right_disparity_px).all()


def test_hidden_and_out_of_frame_are_both_occluded_and_nothing_else_is(root):
    sample = read_frame("sintel", root, "clean/alley_1/frame_0001")
    assert np.argwhere(sample.occluded).tolist() == [[0, 1], [0, 2]]
    assert not sample.right_occluded.any()


def test_masks_of_one_bit_are_read_like_those_of_eight(root):
    write_map(root / "training" / "occlusions" / "alley_1" / "frame_0001.png", [True], False, np.bool_)
    sample = read_frame("sintel", root, "clean/alley_1/frame_0001")
    assert np.argwhere(sample.occluded).tolist() == [[0, 0], [0, 2]]


def test_the_camera_is_unknown_without_the_archive_that_has_it(root):
    assert read_frame("sintel", root, "clean/alley_1/frame_0001").camera is None


def test_the_camera_is_that_of_the_depth_archive_with_the_published_baseline(root):
    write_camera(root, "alley_1/frame_0001")
    expected = StereoCamera(focal_px=1120, baseline_m=0.1, cx_px=511.5, cy_px=217.5)
    assert read_frame("sintel", root, "final/alley_1/frame_0001").camera == expected


@pytest.mark.parametrize(("tag", "extra"), [(1.0, b""), (202021.25, b"more")])
def test_another_file_for_a_camera_is_named(root, tag, extra):
    error_naming(write_camera(root, "alley_1/frame_0001", tag, extra), "sintel", root)


def test_a_camera_that_lacks_is_named(root):
    write_camera(root, "alley_1/frame_0001")
    error_naming(root / "training" / "camdata_left" / "alley_1" / "frame_0002.cam", "sintel", root)


@pytest.mark.parametrize("folder", [*SHADES, "disparities", "occlusions", "outofframe"])
def test_a_missing_file_is_named(root, folder):
    path = root / "training" / folder / "alley_1" / "frame_0002.png"
    path.unlink()
    assert "1 of 3" in error_naming(path, "sintel", root)


@pytest.mark.parametrize("folder", [*SHADES, "disparities", "occlusions", "outofframe"])
def test_a_missing_folder_is_named(root, folder):
    (root / "training" / folder).rename(root / "elsewhere")
    error_naming(root / "training" / folder, "sintel", root)


@pytest.mark.parametrize("folder", [*SHADES, "disparities", "occlusions"])
def test_a_truncated_file_is_named(root, folder):
    path = root / "training" / folder / "alley_1" / "frame_0002.png"
    cut(path)
    error_naming(path, "sintel", root)


@pytest.mark.parametrize("folder", ["clean_right", "disparities", "occlusions", "outofframe"])
def test_a_file_of_another_size_is_named(root, folder):
    path = root / "training" / folder / "alley_1" / "frame_0002.png"
    rest = 0 if folder in ("occlusions", "outofframe") else (0, 0, 0)
    write_map(path, [], rest, np.uint8, shape=(33, 40))
    assert "40x33" in error_naming(path, "sintel", root)


def test_a_grey_disparity_is_named(root):
    path = root / "training" / "disparities" / "alley_1" / "frame_0002.png"
    write_map(path, [], 7, np.uint8)
    assert "mode L" in error_naming(path, "sintel", root)
