import numpy as np
import pytest
from dataset_examples import cut, error_naming, names, read_frame, shades, write_map, write_picture

from stereoweave.data.readers import open_dataset
from stereoweave.stereo import StereoCamera

CALIBRATION = """\
cam0=[3997.684 0 1176.728; 0 3997.684 1011.728; 0 0 1]
cam1=[3997.684 0 1307.839; 0 3997.684 1011.728; 0 0 1]
doffs=131.111
baseline=193.001
width=40
height=32
ndisp=280
"""


def write_scene(folder, pair, maps, shape=(32, 40)):
    """Write pictures of levels 10 and 20, and maps of 24 with an unknown corner beside a 100 (right: 50)."""
    for name, shade in zip(pair, (10, 20), strict=True):
        write_picture(folder / name, shade, shape)
    for name, second in zip(maps, (100, 50), strict=False):
        if name.endswith(".pfm"):
            write_map(folder / name, [np.inf, second + 0.25], 24, np.float32, shape)
        else:
            write_map(folder / name, [0, second], 24, np.uint8, shape)


def write_2001(root):
    pictures = "scene1.row3.col3.ppm", "scene1.row3.col4.ppm"
    write_scene(root / "tsukuba", pictures, ["truedisp.row3.col3.pgm"])
    write_scene(root / "map", ("im0.pgm", "im1.pgm"), ["disp0.pgm", "disp1.pgm"])
    write_scene(root / "venus", ("im2.ppm", "im6.ppm"), ["disp2.pgm", "disp6.pgm"])


def write_2003(root, height_px=375):
    shape = height_px, 40
    write_scene(root / "cones", ("im2.png", "im6.png"), ["disp2.png", "disp6.png"], shape)
    write_scene(root / "teddy", ("im2.ppm", "im6.ppm"), ["disp2.pgm", "disp6.pgm"], shape)


def write_2006(root, height_px=370):
    for scene in ("Aloe", "Wood1"):
        write_scene(
            root / scene, ("view1.png", "view5.png"), ["disp1.png", "disp5.png"], shape=(height_px, 40)
        )
        (root / scene / "dmin.txt").write_text("270\n")


def write_2014(root):
    for scene in ("Adirondack-imperfect", "Adirondack-perfect"):
        write_scene(root / scene, ("im0.png", "im1.png"), ["disp0.pfm", "disp1.pfm"])
        (root / scene / "calib.txt").write_text(CALIBRATION)


WRITERS = {
    "middlebury2001": write_2001,
    "middlebury2003": write_2003,
    "middlebury2005": write_2006,
    "middlebury2006": write_2006,
    "middlebury2014": write_2014,
    "middlebury2021": write_2014,
}


@pytest.fixture(params=WRITERS)
def dataset(request, tmp_path):
    WRITERS[request.param](tmp_path)
    return request.param


def test_a_frame_is_a_scene_with_its_left_and_right_picture(dataset, tmp_path):
    folders = sorted(path.name for path in tmp_path.iterdir())
    assert names(dataset, tmp_path) == folders
    assert {shades(read_frame(dataset, tmp_path, name)) for name in folders} == {(10, 20)}


@pytest.mark.parametrize(
    ("dataset_name", "scene", "scale"),
    [
        ("middlebury2001", "venus", 8),
        ("middlebury2001", "map", 8),
        ("middlebury2001", "tsukuba", 16),
        ("middlebury2003", "cones", 4),
        ("middlebury2003", "teddy", 4),
        ("middlebury2005", "Aloe", 3),
        ("middlebury2006", "Wood1", 3),
    ],
)
def test_grey_levels_are_multiples_of_the_disparity_and_0_is_unknown(tmp_path, dataset_name, scene, scale):
    WRITERS[dataset_name](tmp_path)
    sample = read_frame(dataset_name, tmp_path, scene)
    expected = np.array([np.nan, 100 / scale, 24 / scale], np.float32)
    np.testing.assert_array_equal(sample.disparity_px[0, :3], expected)
    expected[1] /= 2
    if scene == "tsukuba":
        expected[:] = np.nan
    np.testing.assert_array_equal(sample.right_disparity_px[0, :3], expected)


@pytest.mark.parametrize(("height_px", "expected_px"), [(1500, 100), (750, 50), (375, 25)])
def test_the_scale_of_2003_goes_with_the_size(tmp_path, height_px, expected_px):
    write_2003(tmp_path, height_px)
    assert read_frame("middlebury2003", tmp_path, "cones").disparity_px[0, 1] == expected_px


@pytest.mark.parametrize(("height_px", "shrinking"), [(1110, 1), (555, 2), (370, 3)])
def test_disparity_and_camera_of_2006_go_with_the_size(tmp_path, height_px, shrinking):
    write_2006(tmp_path, height_px)
    sample = read_frame("middlebury2006", tmp_path, "Aloe")
    assert sample.disparity_px[0, 1] == np.float32(100 / shrinking)
    assert sample.camera == StereoCamera(
        focal_px=3740 / shrinking,
        baseline_m=0.16,
        cx_px=19.5,
        cy_px=(height_px - 1) / 2,
        doffs_px=270 / shrinking,
    )


@pytest.mark.parametrize("height_px", [1110, 370])
def test_depth_of_2006_is_the_same_in_every_size(tmp_path, height_px):
    write_2006(tmp_path, height_px)
    sample = read_frame("middlebury2006", tmp_path, "Aloe")
    # 3740 px * 0.16 m / (100 + 270) px
    assert sample.camera.depth_m(sample.disparity_px)[0, 1] == pytest.approx(1.617297, abs=1e-5)


def test_lights_and_exposures_of_a_scene_are_frames_of_it(tmp_path):
    write_2006(tmp_path)
    for light in ("Illum1/Exp0", "Illum2/Exp1"):
        write_scene(tmp_path / "Aloe" / light, ("view1.png", "view5.png"), [], shape=(370, 40))
    expected = ["Aloe/Illum1/Exp0", "Aloe/Illum2/Exp1", "Wood1"]
    assert names("middlebury2005", tmp_path) == expected
    assert read_frame("middlebury2005", tmp_path, "Aloe/Illum2/Exp1").disparity_px[0, 1] == np.float32(
        100 / 3
    )


def test_the_scenes_of_2005_that_have_no_ground_truth_are_no_frames(tmp_path):
    write_2006(tmp_path)
    for name in ("view1.png", "view5.png"):
        write_picture(tmp_path / "Dwarves" / name, 10, shape=(370, 40))
    assert names("middlebury2005", tmp_path) == ["Aloe", "Wood1"]


def test_disparity_of_2014_is_a_pfm_where_infinity_is_unknown(tmp_path):
    write_2014(tmp_path)
    sample = read_frame("middlebury2014", tmp_path, "Adirondack-perfect")
    np.testing.assert_array_equal(sample.disparity_px[0, :3], [np.nan, 100.25, 24])
    np.testing.assert_array_equal(sample.right_disparity_px[0, :3], [np.nan, 50.25, 24])


def test_the_camera_of_2014_is_that_of_calib_txt(tmp_path):
    write_2014(tmp_path)
    expected = StereoCamera(
        focal_px=3997.684, baseline_m=0.193001, cx_px=1176.728, cy_px=1011.728, doffs_px=131.111
    )
    assert read_frame("middlebury2014", tmp_path, "Adirondack-perfect").camera == expected


@pytest.mark.parametrize("dataset_name", ["middlebury2001", "middlebury2003"])
def test_no_camera_is_published_for_the_first_two(tmp_path, dataset_name):
    WRITERS[dataset_name](tmp_path)
    assert all(frame.read().camera is None for frame in open_dataset(dataset_name, tmp_path))


def test_the_last_columns_to_be_seen_by_one_view_alone_are_occluded(tmp_path):
    write_2003(tmp_path)
    sample = read_frame("middlebury2003", tmp_path, "teddy")
    # The disparity is 24 / 4 = 6 px: six columns at the left of the left view and at the right of the right
    # view.
    assert np.argwhere(sample.occluded[1]).ravel().tolist() == [0, 1, 2, 3, 4, 5]
    assert np.argwhere(sample.right_occluded[1]).ravel().tolist() == [34, 35, 36, 37, 38, 39]


def test_each_missing_file_is_named(dataset, tmp_path):
    for path in [path for path in tmp_path.rglob("*.*") if path.is_file()]:
        content = path.read_bytes()
        path.unlink()
        # If a picture of 2001 or 2003 is missing, the error names it as .png.
        error_naming(path.with_suffix("") if path.suffix in (".ppm", ".pgm") else path, dataset, tmp_path)
        path.write_bytes(content)


def test_each_truncated_picture_and_map_is_named(dataset, tmp_path):
    for path in [path for path in tmp_path.rglob("*.*") if path.is_file() and path.suffix != ".txt"]:
        content = path.read_bytes()
        cut(path)
        error_naming(path, dataset, tmp_path)
        path.write_bytes(content)


@pytest.mark.parametrize("text", ["", "many", "inf"])
def test_a_dmin_that_is_no_number_is_named(tmp_path, text):
    write_2006(tmp_path)
    (tmp_path / "Aloe" / "dmin.txt").write_text(text)
    error_naming(tmp_path / "Aloe" / "dmin.txt", "middlebury2006", tmp_path)


@pytest.mark.parametrize("dataset_name", ["middlebury2003", "middlebury2005", "middlebury2006"])
def test_a_rescaled_scene_is_named_for_its_unit_is_unknown(tmp_path, dataset_name):
    WRITERS[dataset_name](tmp_path, height_px=369)
    assert "369" in error_naming(tmp_path, dataset_name, tmp_path)


def test_a_map_of_another_size_is_named(dataset, tmp_path):
    scene = min(tmp_path.iterdir())
    path = min(path for path in scene.iterdir() if "disp" in path.name)
    write_map(path, [], 1, np.float32 if path.suffix == ".pfm" else np.uint8, shape=(400, 40))
    assert "40x400" in error_naming(path, dataset, tmp_path)


@pytest.mark.parametrize("dataset_name", ["middlebury2001", "middlebury2003", "middlebury2006"])
def test_a_disparity_in_colour_is_named(tmp_path, dataset_name):
    WRITERS[dataset_name](tmp_path)
    path = min(tmp_path.rglob("disp*"))
    write_map(path, [], (1, 1, 1), np.uint8)
    assert "mode RGB" in error_naming(path, dataset_name, tmp_path)
