import pickle
from pathlib import Path

import numpy as np
import pytest
from dataset_examples import error_of, read_frame, write_map, write_picture

from stereoweave.data.frames import Frame, match_files
from stereoweave.data.readers import DATASETS, open_dataset
from stereoweave.data.samples import find_occluded, make_sample
from stereoweave.stereo import StereoPair

CALIBRATION = "cam0=[300 0 19.5; 0 300 15.5; 0 0 1]\ndoffs=0\nbaseline=100\nwidth=40\nheight=32\n"


@pytest.fixture
def root(tmp_path):
    """Write the smallest dataset in the paper's layout."""
    for folder in ("left", "right"):
        for name in ("b/0001", "a/0002", "a/0001"):
            write_picture(tmp_path / folder / f"{name}.png", 10)
            write_map(tmp_path / "depth" / f"{name}.png", [], 1000, np.uint16)
    (tmp_path / "calib.txt").write_text(CALIBRATION)
    return tmp_path


def test_an_unknown_dataset_is_an_error_that_names_the_known_ones(tmp_path):
    message = error_of(open_dataset, "cityscapes", tmp_path)
    assert "'cityscapes'" in message
    assert "sintel, flyingthings3d, driving, monkaa, kitti2012" in message


@pytest.mark.parametrize("name", DATASETS)
def test_a_missing_root_is_an_error(tmp_path, name):
    assert str(tmp_path / "nowhere") in error_of(open_dataset, name, tmp_path / "nowhere")
    (tmp_path / "file").touch()
    assert "found a file" in error_of(open_dataset, name, tmp_path / "file")


@pytest.mark.parametrize("name", DATASETS)
def test_a_root_without_the_expected_folders_is_an_error(tmp_path, name):
    assert str(tmp_path) in error_of(open_dataset, name, tmp_path)


def test_a_dataset_without_frames_is_an_error(tmp_path):
    for folder in ("left", "right", "depth"):
        (tmp_path / folder).mkdir()
    (tmp_path / "calib.txt").touch()
    assert "archives of paper" in error_of(open_dataset, "paper", tmp_path)


def test_frames_are_sorted_by_name_and_know_their_sequence(root):
    frames = open_dataset("paper", str(root))
    assert [frame.name for frame in frames] == ["a/0001", "a/0002", "b/0001"]
    assert [frame.sequence for frame in frames] == ["a", "a", "b"]


def test_the_sequence_is_all_before_the_last_part():
    frame = Frame(name="clean/alley_1/frame_0001", read=lambda: pytest.fail("not asked for"))
    assert frame.sequence == "clean/alley_1"


def test_opening_reads_no_file(root):
    for path in root.rglob("*.*"):
        path.write_bytes(b"nothing")
    assert len(open_dataset("paper", root)) == 3


def test_frames_travel_to_other_processes(root):
    (frame, *_) = pickle.loads(pickle.dumps(open_dataset("paper", root)))
    np.testing.assert_array_equal(frame.read().left, read_frame("paper", root, "a/0001").left)


def test_every_dataset_is_a_word_for_a_recipe():
    assert all(name.isidentifier() for name in DATASETS)


# Matching of files


def test_files_are_matched_by_their_path_below_each_folder(tmp_path):
    for name in ("left/a/1.png", "right/a/1.webp", "left/2.png", "right/2.pfm"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert match_files(tmp_path / "left", tmp_path / "right") == {
        "2": [tmp_path / "left/2.png", tmp_path / "right/2.pfm"],
        "a/1": [tmp_path / "left/a/1.png", tmp_path / "right/a/1.webp"],
    }


@pytest.mark.parametrize("name", [".hidden.png", "._1.png", "readme.txt", "Thumbs.db"])
def test_files_that_are_not_pictures_are_ignored(tmp_path, name):
    (tmp_path / "1.png").touch()
    (tmp_path / name).touch()
    assert list(match_files(tmp_path)) == ["1"]


def test_a_file_that_any_folder_lacks_is_named(tmp_path):
    for name in ("left/1.png", "left/2.png", "right/2.png", "right/3.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    message = error_of(match_files, tmp_path / "left", tmp_path / "right")
    assert str(Path("left", "3.png")) in message
    assert "1 of 3" in message


# Occlusion


def row(*values_px):
    return np.array([values_px], np.float32)


def test_a_match_beside_the_other_picture_is_hidden():
    # Columns 0 to 3 have their matches at -2, -1, 0 and 1.
    assert find_occluded(row(2, 2, 2, 2), row(2, 2, 2, 2)).tolist() == [[True, True, False, False]]
    # Behind the plane of convergence, matches are farther right.
    assert find_occluded(row(-1, -1, -1, -1), row(-1, -1, -1, -1)).tolist() == [[False, False, False, True]]


def test_a_match_behind_something_nearer_is_hidden():
    # A block at 3 px is in front of a ground at 1 px. It is in columns 4 and 5 of this view and in columns 1
    # and 2 of the other one, where it occludes the ground of this view's columns 2 and 3.
    disparity_px, other_px = row(1, 1, 1, 1, 3, 3, 1, 1), row(1, 3, 3, 1, 1, 1, 1, 1)
    assert find_occluded(disparity_px, other_px).tolist() == [
        [True, False, True, True, False, False, False, False]
    ]


@pytest.mark.parametrize(("match", "behind"), [(2.25, True), (2.75, False)])
def test_at_a_jump_the_column_nearer_to_the_match_decides(match, behind):
    # The ground is in column 4 of this view; in the other view, a block at 8 px ends after column 2.
    ground_px = 4 - match
    disparity_px, other_px = row(*5 * [ground_px]), row(8, 8, 8, ground_px, ground_px)
    assert find_occluded(disparity_px, other_px)[0, 4] == behind


def test_a_slope_does_not_occlude_itself():
    # d = 2 x / 3 in this view, so column x is column x / 3 of the other view, whose disparity is twice the
    # column.
    columns = np.arange(16, dtype=np.float32)[None]
    assert not find_occluded(2 * columns / 3, 2 * columns).any()


def test_surfaces_that_all_but_touch_do_not_hide_each_other():
    assert find_occluded(row(0, 0, 0), row(0.5, 0.625, -9)).tolist() == [[False, True, False]]


def test_unknown_pixels_are_not_occluded():
    nan = np.nan
    assert not find_occluded(row(nan, nan, 0, 1), row(9, 9, nan, nan)).any()
    assert find_occluded(row(1, nan, nan, nan), row(nan, nan, nan, nan)).tolist() == [
        [True, False, False, False]
    ]


def test_the_right_view_is_treated_as_the_mirror_shows_it():
    image = np.zeros((1, 8, 3), np.uint8)
    left_px, right_px = row(1, 1, 1, 1, 3, 3, 1, 1), row(1, 3, 3, 1, 1, 1, 1, 1)
    sample = make_sample(StereoPair(left=image, right=image), left_px, right_px)
    # The ground in columns 3 and 4 of the right view is at 4 and 5 of the left one, behind the block; column
    # 7 is beside it.
    assert sample.right_occluded.tolist() == [[False, False, False, True, True, False, False, True]]


def test_a_mask_of_the_dataset_s_own_is_kept():
    image, disparity_px = np.zeros((1, 4, 3), np.uint8), row(2, 2, 2, 2)
    mask = np.array([[False, False, False, True]])
    sample = make_sample(StereoPair(left=image, right=image), disparity_px, occluded=mask)
    assert sample.occluded.tolist() == mask.tolist()
