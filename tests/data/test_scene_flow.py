from itertools import product

import numpy as np
import pytest
from dataset_examples import SHAPE, cut, error_naming, names, read_frame, shades, write_map, write_picture

from stereoweave.io import maps
from stereoweave.stereo import StereoCamera

PASSES = {"frames_cleanpass": 10, "frames_finalpass": 30}
DRIVING = [
    "/".join(parts)
    for parts in product(
        ("15mm_focallength", "35mm_focallength"), ("scene_backwards", "scene_forwards"), ("fast", "slow")
    )
]
RUNS = {
    "flyingthings3d": ["TEST/A/0000", "TRAIN/A/0000", "TRAIN/C/0749"],
    "driving": DRIVING,
    "monkaa": ["a_rain_of_stones_x2", "treeflight_x2"],
}


def write_dataset(root, dataset, frames=("0006", "0007"), suffix=".png"):
    for run, frame in product(RUNS[dataset], frames):
        for folder, shade in PASSES.items():
            write_picture(root / folder / run / "left" / f"{frame}{suffix}", shade)
            write_picture(root / folder / run / "right" / f"{frame}{suffix}", shade + 10)
        write_map(root / "disparity" / run / "left" / f"{frame}.pfm", [7.25], 2.5, np.float32)
        write_map(root / "disparity" / run / "right" / f"{frame}.pfm", [], 2.5, np.float32)
    return root


@pytest.fixture
def monkaa(tmp_path):
    return write_dataset(tmp_path, "monkaa")


@pytest.mark.parametrize("dataset", RUNS)
def test_frames_are_of_both_passes_and_every_run_by_name(tmp_path, dataset):
    write_dataset(tmp_path, dataset)
    runs = [f"{kind}/{run}" for kind in ("clean", "final") for run in RUNS[dataset]]
    assert names(dataset, tmp_path) == [f"{run}/{frame}" for run in runs for frame in ("0006", "0007")]


def test_driving_has_two_passes_lenses_directions_and_speeds(tmp_path):
    write_dataset(tmp_path, "driving", frames=["0001"])
    assert len(names("driving", tmp_path)) == 2 * 2 * 2 * 2
    assert "final/35mm_focallength/scene_forwards/slow/0001" in names("driving", tmp_path)


@pytest.mark.parametrize(("kind", "expected"), [("clean", (10, 20)), ("final", (30, 40))])
def test_each_pass_has_its_own_pictures(monkaa, kind, expected):
    assert shades(read_frame("monkaa", monkaa, f"{kind}/treeflight_x2/0006")) == expected


@pytest.mark.parametrize("absent", PASSES)
def test_one_pass_alone_will_do(monkaa, absent):
    (monkaa / absent).rename(monkaa / "elsewhere")
    kind = "final" if absent == "frames_cleanpass" else "clean"
    assert names("monkaa", monkaa) == [
        f"{kind}/{run}/{i}" for run in RUNS["monkaa"] for i in ("0006", "0007")
    ]


def test_pictures_may_be_webp_as_they_are_also_published(tmp_path):
    write_dataset(tmp_path, "monkaa", suffix=".webp")
    assert shades(read_frame("monkaa", tmp_path, "clean/treeflight_x2/0007")) == (10, 20)


def test_both_disparities_are_read_and_tell_what_is_hidden(monkaa):
    sample = read_frame("monkaa", monkaa, "clean/treeflight_x2/0006")
    np.testing.assert_array_equal(sample.disparity_px[0, :3], [7.25, 2.5, 2.5])
    assert (sample.right_disparity_px == 2.5).all()
    # At 2.5 px, the first three columns of the left view have their matches outside the right picture, and
    # the last three columns of the right view have theirs outside the left one.
    assert np.argwhere(sample.occluded[1]).ravel().tolist() == [0, 1, 2]
    assert np.argwhere(sample.right_occluded[1]).ravel().tolist() == [37, 38, 39]


@pytest.mark.parametrize("sides", [["left"], ["right"], ["left", "right"]])
def test_disparity_is_positive_whatever_sign_a_release_gives_it(monkaa, sides):
    for side in sides:
        path = monkaa / "disparity" / "treeflight_x2" / side / "0006.pfm"
        maps.write_pfm(path, -maps.read_pfm(path))
    sample = read_frame("monkaa", monkaa, "clean/treeflight_x2/0006")
    assert sample.disparity_px[0, 0] == 7.25
    assert sample.right_disparity_px[0, 0] == 2.5


def test_a_map_with_both_signs_is_named(monkaa):
    path = monkaa / "disparity" / "treeflight_x2" / "right" / "0006.pfm"
    write_map(path, [-1.5], 2.5, np.float32)
    assert "-1.500 to 2.500" in error_naming(path, "monkaa", monkaa)


def test_infinity_is_unknown(monkaa):
    write_map(monkaa / "disparity" / "treeflight_x2" / "left" / "0006.pfm", [np.inf], np.nan, np.float32)
    assert np.isnan(read_frame("monkaa", monkaa, "clean/treeflight_x2/0006").disparity_px).all()


@pytest.mark.parametrize(
    ("dataset", "name", "focal_px"),
    [
        ("driving", "clean/15mm_focallength/scene_backwards/fast/0006", 450),
        ("driving", "final/35mm_focallength/scene_forwards/slow/0006", 1050),
        ("flyingthings3d", "clean/TEST/A/0000/0006", 1050),
        ("monkaa", "clean/treeflight_x2/0006", 1050),
    ],
)
def test_the_camera_is_that_of_the_lens(tmp_path, dataset, name, focal_px):
    write_dataset(tmp_path, dataset)
    expected = StereoCamera(focal_px=focal_px, baseline_m=1, cx_px=479.5, cy_px=269.5)
    assert read_frame(dataset, tmp_path, name).camera == expected


@pytest.mark.parametrize(
    "file",
    ["frames_cleanpass/{}/left/0007.png", "frames_finalpass/{}/right/0007.png", "disparity/{}/left/0007.pfm"],
)
def test_a_missing_file_is_named(monkaa, file):
    path = monkaa / file.format("treeflight_x2")
    path.unlink()
    error_naming(path, "monkaa", monkaa)


@pytest.mark.parametrize(
    "folder", ["disparity", "disparity/treeflight_x2/right", "frames_cleanpass/treeflight_x2/left"]
)
def test_a_missing_folder_is_named(monkaa, folder, tmp_path_factory):
    (monkaa / folder).rename(tmp_path_factory.mktemp("elsewhere") / "folder")
    error_naming(monkaa / folder, "monkaa", monkaa)


def test_a_root_without_any_pass_is_named(tmp_path):
    (tmp_path / "disparity").mkdir()
    assert "frames_cleanpass or frames_finalpass" in error_naming(tmp_path, "monkaa", tmp_path)


def test_a_dataset_is_not_taken_for_another(tmp_path):
    write_dataset(tmp_path, "flyingthings3d")
    error_naming(tmp_path / "frames_cleanpass" / "15mm_focallength", "driving", tmp_path)


@pytest.mark.parametrize("file", ["frames_cleanpass/{}/right/0007.png", "disparity/{}/right/0007.pfm"])
def test_a_truncated_file_is_named(monkaa, file):
    path = monkaa / file.format("treeflight_x2")
    cut(path)
    error_naming(path, "monkaa", monkaa)


def test_a_disparity_of_another_size_is_named(monkaa):
    path = monkaa / "disparity" / "treeflight_x2" / "right" / "0007.pfm"
    write_map(path, [], 1, np.float32, shape=(33, 40))
    assert "40x33" in error_naming(path, "monkaa", monkaa)


def test_a_pfm_of_three_channels_is_named(monkaa):
    path = monkaa / "disparity" / "treeflight_x2" / "left" / "0007.pfm"
    path.write_bytes(b"PF\n40 32\n-1.0\n" + bytes(12 * SHAPE[0] * SHAPE[1]))
    error_naming(path, "monkaa", monkaa)
