import numpy as np
import pytest

from stereoweave.cameras.calibration_files import read_rig
from stereoweave.data.readers import read_scenes
from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io import images, maps

CALIBRATION = "cam0=[100 0 20; 0 100 16; 0 0 1]\ndoffs=0\nbaseline=50\nwidth=40\nheight=32\n"


@pytest.fixture
def scene(tmp_path, rng):
    """Return the folder of a scene without ground truth."""
    folder = tmp_path / "scenes" / "motorcycle"
    for side in ("left", "right"):
        images.write_image(folder / f"{side}.png", rng.integers(0, 256, (32, 40, 3), dtype=np.uint8))
    return folder


def test_a_scene_has_its_name_its_pair_and_nan_where_the_truth_is_unknown(scene):
    truth_px = np.full((32, 40), 7.5, np.float32)
    truth_px[3, 4] = np.nan
    maps.write_disparity_png(scene / "disparity.png", truth_px)
    (read,) = read_scenes(scene.parent)
    assert read.name == "motorcycle"
    np.testing.assert_array_equal(read.pair.left, images.read_image(scene / "left.png"))
    np.testing.assert_array_equal(read.pair.right, images.read_image(scene / "right.png"))
    np.testing.assert_array_equal(read.truth_px, truth_px)
    assert read.pair.camera is None


def test_infinity_in_a_pfm_is_unknown(scene):
    maps.write_pfm(scene / "disparity.pfm", np.full((32, 40), np.inf))
    (read,) = read_scenes(scene.parent)
    assert np.isnan(read.truth_px).all()


def test_a_calibration_beside_the_pictures_gives_the_camera(scene):
    maps.write_pfm(scene / "disparity.pfm", np.ones((32, 40)))
    (scene / "calib.txt").write_text(CALIBRATION)
    (read,) = read_scenes(scene.parent)
    assert read.pair.camera == read_rig(scene / "calib.txt").camera()


def test_scenes_come_by_name_and_other_folders_are_passed_over(scene):
    maps.write_pfm(scene / "disparity.pfm", np.ones((32, 40)))
    (scene.parent / "notes").mkdir()
    for name in ("adirondack", "pipes"):
        (scene.parent / name).symlink_to(scene)
    assert [read.name for read in read_scenes(scene.parent)] == ["adirondack", "motorcycle", "pipes"]


@pytest.mark.parametrize(("folder", "found"), [(".", "neither"), ("nowhere", "no such folder")])
def test_a_folder_without_scenes_is_an_error_at_once(tmp_path, folder, found):
    with pytest.raises(
        StereoweaveError, match=f"expected <scene>/left.png below it, or rendered sets, found {found}"
    ):
        read_scenes(tmp_path / folder)


def test_a_scene_without_ground_truth_is_an_error(scene):
    with pytest.raises(FormatError, match=r"disparity.png: expected .*, found no such file"):
        list(read_scenes(scene.parent))


def test_ground_truth_of_another_size_is_an_error(scene):
    maps.write_pfm(scene / "disparity.pfm", np.ones((32, 41)))
    with pytest.raises(
        FormatError,
        match=r"of the same shape as the pictures, \(32, 40\).*found \(32, 41\)",
    ):
        list(read_scenes(scene.parent))


@pytest.mark.testdata
def test_the_real_pairs_are_twelve_and_mostly_known(testdata):
    scenes = list(read_scenes(testdata / "stereo" / "pairs"))
    assert len(scenes) == 12
    (motorcycle,) = (scene for scene in scenes if scene.name == "motorcycle")
    assert motorcycle.pair.left.shape == (500, 741, 3)
    assert 100 * np.isfinite(motorcycle.truth_px).mean() == pytest.approx(92.7, abs=0.05)
    assert np.nanmax(motorcycle.truth_px) == pytest.approx(59.91, abs=0.005)
