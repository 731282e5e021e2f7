from dataclasses import replace

import cv2
import numpy as np
import pytest
from rig_examples import fisheye, pinhole, rig_of, turned

from stereoweave.cameras import rig as calibration
from stereoweave.cameras.calibration_files import add_camera, read_rig, write_rig
from stereoweave.cameras.rectify import rectify
from stereoweave.cameras.rig import Optics, Rig
from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.stereo import StereoCamera, StereoPair

MIDDLEBURY = """\
cam0=[994.978 0 311.193; 0 994.978 254.877; 0 0 1]
cam1=[994.978 0 342.279; 0 994.978 254.877; 0 0 1]
doffs=31.086
baseline=193.001
width=741
height=497
ndisp=70
"""
KITTI = """\
P0: 700 0 600 0 0 700 170 0 0 0 1 0
P1: 700 0 600 -350 0 700 170 0 0 0 1 0
P2: 700 0 600 35 0 700 170 0.2 0 0 1 0.003
P3: 700 0 600 -336 0 700 170 2.2 0 0 1 0.002
"""
# Camera 2 is at the position of camera 0. Camera 3 is half a metre to the right, rotated by 90 degrees about
# z.
KITTI_RAW = """\
calib_time: 09-Jan-2012 13:57:47
corner_dist: 9.950000e-02
S_02: 1392 512
K_02: 900 0 690 0 901 250 0 0 1
D_02: -0.37 0.2 0.001 0.002 -0.07
R_02: 1 0 0 0 1 0 0 0 1
T_02: 0 0 0
S_rect_02: 1242 375
R_rect_02: 1 0 0 0 1 0 0 0 1
P_rect_02: 700 0 600 0 0 700 170 0 0 0 1 0
S_03: 1392 512
K_03: 910 0 680 0 911 260 0 0 1
D_03: -0.36 0.1 0.001 0.002 -0.06
R_03: 0 -1 0 1 0 0 0 0 1
T_03: -0.5 0 0
S_rect_03: 1242 375
R_rect_03: 1 0 0 0 1 0 0 0 1
P_rect_03: 700 0 600 -350 0 700 170 0 0 0 1 0
"""
KALIBR = """\
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.01, 2e-3, -3.0e-04, 0.0005]
  distortion_model: equidistant
  intrinsics: [461.6, 460.3, 363.0, 248.1]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.001]
  - [0.0, 0.0, 1.0, 0.002]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [-0.02, 0.003, -0.0004, 0.0006]
  distortion_model: equidistant
  intrinsics: [460.0, 459.0, 373.0, 254.1]
  resolution: [752, 480]
"""
OPENCV = """\
%YAML:1.0
---
K1: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 550., 0., 320., 0., 551., 240., 0., 0., 1. ]
D1: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -2.8e-01, 9.e-02, 0., 0., 0. ]
K2: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 552., 0., 321., 0., 553., 241., 0., 0., 1. ]
D2: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -2.7e-01, 8.e-02, 0., 0., 0. ]
R: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1., 0., 0., 0., 1., 0., 0., 0., 1. ]
T: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [ -120., 0., 1. ]
image_width: 640
image_height: 480
"""


def stored(tmp_path, text, name="calibration.txt"):
    (tmp_path / name).write_text(text)
    return tmp_path / name


def refusal(path):
    """Read the file, which must fail; return the error's line, which must name the file."""
    with pytest.raises(FormatError) as caught:
        read_rig(path)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: expected")
    return message


def assert_same(found, expected):
    for side in ("left", "right"):
        one, other = getattr(found, side), getattr(expected, side)
        np.testing.assert_array_equal(one.matrix, other.matrix)
        np.testing.assert_array_equal(one.distortion, other.distortion)
        assert one.fisheye == other.fisheye
    np.testing.assert_array_equal(found.rotation, expected.rotation)
    np.testing.assert_array_equal(found.translation_m, expected.translation_m)
    assert found.size_px == expected.size_px


def pair_of(width_px, height_px):
    image = np.zeros((height_px, width_px, 3), np.uint8)
    return StereoPair(left=image, right=image)


# Middlebury


def test_a_middlebury_calibration_is_read_with_its_baseline_in_metres(tmp_path):
    camera = read_rig(stored(tmp_path, MIDDLEBURY)).camera()
    assert (camera.focal_px, camera.baseline_m) == (994.978, 0.193001)
    assert (camera.cx_px, camera.cy_px) == (311.193, 254.877)
    assert camera.doffs_px == pytest.approx(31.086)


@pytest.mark.parametrize("text", ["\ufeff" + MIDDLEBURY, MIDDLEBURY.replace("=", " = ")])
def test_a_middlebury_calibration_that_an_editor_has_touched_is_read_too(tmp_path, text):
    assert read_rig(stored(tmp_path, text)).camera().doffs_px == pytest.approx(31.086)


def test_a_pair_gets_the_camera_of_a_calibration_for_its_size(tmp_path):
    path = stored(tmp_path, MIDDLEBURY)
    assert add_camera(pair_of(741, 497), path).camera == read_rig(path).camera()


def test_a_calibration_for_another_size_is_refused(tmp_path):
    path = stored(tmp_path, MIDDLEBURY)
    with pytest.raises(FormatError, match="for pictures of 370x248, found one for 741x497") as caught:
        add_camera(pair_of(370, 248), path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("cam0", "camera", "no entry cam0"),
        ("baseline=193.001\nwidth=741\n", "", "no entry baseline, width"),
        ("31.086", "thirty", "thirty"),
        ("baseline=193.001", "baseline=0", "which is not positive"),
        ("=[994.978 0", "=[-994.978 0", "focal lengths of at least 1 px"),
        ("; 0 994.978 254.877; 0 0 1]", "]", "size 3"),
    ],
)
def test_an_invalid_middlebury_calibration_is_refused(tmp_path, old, new, found):
    assert found in refusal(stored(tmp_path, MIDDLEBURY.replace(old, new, 1)))


# KITTI


def test_kittis_colour_cameras_are_read_from_calib_txt(tmp_path):
    rig = read_rig(stored(tmp_path, KITTI))
    camera = rig.camera()
    assert (camera.focal_px, camera.cx_px, camera.cy_px, camera.doffs_px) == (700, 600, 170, 0)
    assert camera.baseline_m == pytest.approx((35 + 336) / 700)
    assert rig.size_px is None
    assert "camera 2 is used as the left one" in rig.notes[0].text


def test_a_calibration_without_a_size_is_doubted_if_its_centre_is_far_from_the_pictures(tmp_path):
    path = stored(tmp_path, KITTI)
    sizes_px = (1242, 375), (621, 188), (2484, 750)
    fitting, halved, doubled = (read_rig(path, size_px).notes for size_px in sizes_px)
    assert (len(fitting), len(doubled)) == (1, 2)
    assert halved[:-1] == fitting
    assert str(halved[-1]) == (
        "the calibration seems to be for pictures of another size: its principal point, 600, 170, is far "
        "from the centre of 621x188; scale its focal lengths and principal points with the pictures "
        "(calibration)"
    )
    assert read_rig(stored(tmp_path, MIDDLEBURY), (160, 120)).notes == ()  # `check_size` refuses this size


def test_kittis_grey_cameras_are_read_where_the_colour_ones_are_missing(tmp_path):
    camera = read_rig(stored(tmp_path, "\n".join(KITTI.splitlines()[:2]))).camera()
    assert camera.baseline_m == 0.5


def test_kittis_calibration_of_the_raw_pictures_is_taken_for_their_size(tmp_path):
    path = stored(tmp_path, KITTI_RAW)
    raw = read_rig(path, (1392, 512))
    assert raw.size_px == (1392, 512)
    np.testing.assert_array_equal(raw.right.distortion, [-0.36, 0.1, 0.001, 0.002, -0.06])
    np.testing.assert_array_equal(raw.left.matrix, [[900, 0, 690], [0, 901, 250], [0, 0, 1]])
    np.testing.assert_array_equal(raw.rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_array_equal(raw.translation_m, [-0.5, 0, 0])
    for size_px in (None, (1242, 375)):
        rectified = read_rig(path, size_px)
        assert rectified.size_px == (1242, 375)
        assert rectified.camera().baseline_m == 0.5


def test_the_pose_between_two_rotated_kitti_cameras_equals_the_manual_result(tmp_path):
    # Camera 2 is rotated by 90 degrees about z, camera 3 by 90 degrees about x. From 2 to 3: R = R3 R2^T =
    # [1 0 0; 0 0 -1; 0 1 0] [0 1 0; -1 0 0; 0 0 1], and T = T3 - R T2 = (-0.5, 0, 0) - (2, -3, -1).
    turned_both = (
        KITTI_RAW.replace("R_02: 1 0 0 0 1 0 0 0 1", "R_02: 0 -1 0 1 0 0 0 0 1")
        .replace("T_02: 0 0 0", "T_02: 1 2 3")
        .replace("R_03: 0 -1 0 1 0 0 0 0 1", "R_03: 1 0 0 0 0 -1 0 1 0")
    )
    rig = read_rig(stored(tmp_path, turned_both), (1392, 512))
    np.testing.assert_array_equal(rig.rotation, [[0, 1, 0], [0, 0, -1], [-1, 0, 0]])
    np.testing.assert_array_equal(rig.translation_m, [-2.5, 3, 1])


def test_a_kitti_file_without_the_second_camera_is_refused(tmp_path):
    text = "\n".join(line for line in KITTI_RAW.splitlines() if "_03" not in line)
    assert "no entry" in refusal(stored(tmp_path, text))


# Kalibr


def test_kalibrs_camchain_is_read_with_its_fisheye_lenses(tmp_path):
    rig = read_rig(stored(tmp_path, KALIBR))
    assert_same(
        rig,
        Rig(
            left=Optics(
                matrix=np.array([[461.6, 0, 363.0], [0, 460.3, 248.1], [0, 0, 1]]),
                distortion=np.array([-0.01, 0.002, -0.0003, 0.0005]),
                fisheye=True,
            ),
            right=Optics(
                matrix=np.array([[460.0, 0, 373.0], [0, 459.0, 254.1], [0, 0, 1]]),
                distortion=np.array([-0.02, 0.003, -0.0004, 0.0006]),
                fisheye=True,
            ),
            rotation=np.eye(3),
            translation_m=np.array([-0.11, 0.001, 0.002]),
            size_px=(752, 480),
        ),
    )


def test_kalibrs_radtan_is_a_pinhole(tmp_path):
    rig = read_rig(stored(tmp_path, KALIBR.replace("equidistant", "radtan")))
    assert not rig.left.fisheye and not rig.right.fisheye


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("cam1", "cam2", "no cameras cam0 and cam1"),
        ("T_cn_cnm1", "T_cam_imu", "no entry T_cn_cnm1"),
        ("camera_model: pinhole", "camera_model: omni", "omni"),
        ("distortion_model: equidistant", "distortion_model: fov", "fov"),
        ("  intrinsics: [461.6, 460.3, 363.0, 248.1]\n", "", "no entry intrinsics in cam0"),
        ("  - [0.0, 0.0, 0.0, 1.0]\n", "", "size 12"),
        ("[1.0, 0.0, 0.0, -0.11]", "[2.0, 0.0, 0.0, -0.11]", "rotation matrix"),
        ("[461.6,", "[461.6", "cannot be read"),
    ],
)
def test_an_invalid_camchain_is_refused(tmp_path, old, new, found):
    assert found in refusal(stored(tmp_path, KALIBR.replace(old, new, 1)))


# OpenCV


def test_opencvs_yaml_in_millimetres_is_read_in_metres_and_says_so(tmp_path):
    rig = read_rig(stored(tmp_path, OPENCV))
    np.testing.assert_allclose(rig.translation_m, [-0.12, 0, 0.001])
    np.testing.assert_array_equal(rig.left.distortion, [-0.28, 0.09, 0, 0, 0])
    np.testing.assert_array_equal(rig.right.matrix, [[552, 0, 321], [0, 553, 241], [0, 0, 1]])
    assert rig.size_px == (640, 480)
    assert len(rig.notes) == 1 and "is assumed to be in millimetres" in rig.notes[0].text


def test_a_short_baseline_without_unit_is_taken_for_metres(tmp_path):
    rig = read_rig(stored(tmp_path, OPENCV.replace("-120., 0., 1.", "-0.12, 0., 0.001")))
    np.testing.assert_allclose(rig.translation_m, [-0.12, 0, 0.001])
    assert str(rig.notes[0]).endswith(
        "is assumed to be in metres; add the entry translation_unit: m, cm or mm if that is wrong"
    )


def test_a_unit_and_a_lens_that_are_stated_need_no_guess(tmp_path):
    text = (
        OPENCV.replace("-120., 0., 1.", "-12., 0., 0.1") + "translation_unit: cm\ndistortion_model: radtan\n"
    )
    rig = read_rig(stored(tmp_path, text))
    np.testing.assert_allclose(rig.translation_m, [-0.12, 0, 0.001])
    assert rig.notes == ()


def test_four_coefficients_are_a_pinholes_unless_the_file_says_fisheye(tmp_path):
    four = OPENCV.replace("cols: 5", "cols: 4").replace(", 0., 0., 0. ]\n", ", 0., 0. ]\n")
    four = four.replace(
        "550., 0., 320., 0., 551., 240., 0., 0. ]", "550., 0., 320., 0., 551., 240., 0., 0., 1. ]"
    )
    guessed = read_rig(stored(tmp_path, four))
    assert not guessed.left.fisheye
    assert str(guessed.notes[-1]) == (
        "the calibration does not state its lens model: a pinhole with k1 k2 p1 p2 is assumed; "
        "add the entry distortion_model: fisheye if that is wrong"
    )
    for said in ("distortion_model: fisheye", "fisheye_model: 1", "camera_model: Kannala-Brandt"):
        assert read_rig(stored(tmp_path, f"{four}{said}\n")).left.fisheye


@pytest.mark.parametrize(
    ("said", "fisheye"),
    [
        *((word, True) for word in ("1", "1.0", "1.", "true", "TRUE", "yes", "on", "y")),
        *((word, False) for word in ("0", "0.", "false", "False", "no", "OFF", "n")),
    ],
)
def test_a_lens_is_a_fisheye_in_each_word_for_yes_that_programs_write(tmp_path, said, fisheye):
    text = OPENCV.replace("cols: 5", "cols: 4").replace(", 0., 0., 0. ]\n", ", 0., 0. ]\n")
    text = text.replace(
        "550., 0., 320., 0., 551., 240., 0., 0. ]", "550., 0., 320., 0., 551., 240., 0., 0., 1. ]"
    )
    assert read_rig(stored(tmp_path, f"{text}fisheye: {said}\n")).left.fisheye is fisheye


@pytest.mark.parametrize("null", ["~", "null", "Null", "NULL", ""])
def test_an_entry_of_null_counts_as_left_out(tmp_path, null):
    names = ("distortion_model", "translation_unit", "fisheye", "image_size")
    more = "".join(f"{name}: {null}\n" for name in names)
    assert_same(read_rig(stored(tmp_path, OPENCV + more)), read_rig(stored(tmp_path, OPENCV)))


def test_hexadecimal_numbers_are_read_too(tmp_path):
    text = OPENCV + "image_size: [0x280, +0X1e0]\nT: [-0x78, 0, 0x0]\n"
    rig = read_rig(stored(tmp_path, text))
    assert rig.size_px == (640, 480)
    np.testing.assert_allclose(rig.translation_m, [-0.12, 0, 0])


def test_other_names_and_plain_lists_are_read_too(tmp_path):
    text = """\
cameraMatrixLeft: [[550, 0, 320], [0, 551, 240], [0, 0, 1]]
dist_coeffs_left: [-1e-3, 0, 0, 0, 0]
cameraMatrixRight: [[550, 0, 320], [0, 551, 240], [0, 0, 1]]
dist_coeffs_right: [0, 0, 0, 0, 0]
rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
translation: [-0.1, 0, 0]
image_size: [640, 480]
"""
    rig = read_rig(stored(tmp_path, text))
    assert rig.left.distortion[0] == -0.001
    assert rig.size_px == (640, 480)


def test_extrinsics_are_completed_by_the_intrinsics_beside_them(tmp_path):
    lines = OPENCV.replace("K1", "M1").replace("K2", "M2").splitlines(keepends=True)
    at = next(number for number, line in enumerate(lines) if line.startswith("R:"))
    stored(tmp_path, "".join(lines[:at]), "intrinsics.yml")
    stored(tmp_path, "".join(lines[:2] + lines[at:]), "extrinsics.yml")
    whole = read_rig(stored(tmp_path, OPENCV))
    for name in ("intrinsics.yml", "extrinsics.yml"):
        assert_same(read_rig(tmp_path / name), whole)


@pytest.mark.parametrize(
    "projection",
    [
        "P1: [[550, 0, 320, 0], [0, 550, 240, 0], [0, 0, 1, 0]]",
        "P1: !!opencv-matrix\n   rows: 1\n   cols: 1\n   dt: d\n   data: [ 1. ]",
        "P1:\n- [550, 0, 320, 0]",
    ],
)
def test_projection_matrices_in_an_opencv_file_do_not_make_it_kittis(tmp_path, projection):
    rig = read_rig(stored(tmp_path, f"{OPENCV}{projection}\n"))
    assert_same(rig, read_rig(stored(tmp_path, OPENCV)))


@pytest.mark.parametrize(
    ("more", "found"),
    [
        ("image_size: 640", "a picture size '640' instead of width and height"),
        ("image_size: [640, 480, 3]", "instead of width and height"),
        ("M1: {rows: 3}", "{'rows': '3'} instead of numbers"),
        ("fisheye: maybe", "fisheye: 'maybe', not one of true, yes, on, y, false, no, off, n or a number"),
        ("fisheye: [1]", "fisheye: ['1'], not one of"),
        ("fisheye: .nan", "fisheye: '.nan', not one of"),
        ("fisheye: nan", "fisheye: 'nan', not one of"),
        ("translation_unit: [mm]", "translation_unit ['mm'], not one of m, cm, mm"),
    ],
)
def test_an_invalid_size_matrix_or_unit_is_refused(tmp_path, more, found):
    assert found in refusal(stored(tmp_path, f"{OPENCV}{more}\n"))


def test_what_an_opencv_file_lacks_is_named(tmp_path):
    assert "no entry for translation (M1" in refusal(stored(tmp_path, OPENCV.replace("T:", "U:")))


@pytest.mark.parametrize("lens", [pinhole, fisheye])
def test_a_rig_comes_back_exactly_as_it_was_written(tmp_path, lens):
    rig = rig_of(lens)
    write_rig(tmp_path / "rig.yml", rig)
    read = read_rig(tmp_path / "rig.yml")
    assert_same(read, rig)
    assert read.notes == ()
    assert [path.name for path in tmp_path.iterdir()] == ["rig.yml"]


def test_opencv_reads_a_rig_that_was_written_and_its_xml_is_read(tmp_path):
    rig = rig_of(pinhole)
    write_rig(tmp_path / "rig.yml", rig)
    ours = cv2.FileStorage(str(tmp_path / "rig.yml"), cv2.FILE_STORAGE_READ)
    xml = cv2.FileStorage(str(tmp_path / "rig.xml"), cv2.FILE_STORAGE_WRITE)
    for name in ("M1", "D1", "M2", "D2", "R", "T"):
        xml.write(name, ours.getNode(name).mat())
    xml.write("image_width", 640)
    xml.write("image_height", 480)
    xml.write("translation_unit", "m")
    xml.release()
    assert_same(read_rig(tmp_path / "rig.xml"), rig)


# Any file


@pytest.mark.parametrize(
    "content", [b"", b"hello", b"\x89PNG\r\n\x1a\n\x00\x01", b"[1, 2]", b"<a>", b"{", b"a: !!b 1"]
)
def test_a_file_that_is_not_a_calibration_is_refused(tmp_path, content):
    (tmp_path / "file").write_bytes(content)
    assert "a calibration of two cameras" in refusal(tmp_path / "file")


def test_a_calibration_that_is_not_there_is_named(tmp_path):
    assert refusal(tmp_path / "nowhere.yml").endswith("no such file")


# Rigs


def test_only_a_rectified_rig_gives_a_camera(tmp_path):
    flat = read_rig(stored(tmp_path, MIDDLEBURY))
    other = [
        Optics(matrix=flat.right.matrix + np.array(added), distortion=np.zeros(0))
        for added in (
            [[2, 0, 0], [0, 0, 0], [0, 0, 0]],
            [[0, 0, 0], [0, 2, 0], [0, 0, 0]],
            [[0, 0, 0], [0, 0, 2], [0, 0, 0]],
        )
    ]
    for unlike, reason in (
        (replace(flat, left=pinhole()), "lenses with distortion"),
        (replace(flat, rotation=turned(0, 1, 0)), "rotated by 1.00 degrees"),
        (replace(flat, translation_m=np.array([-0.1, 0.01, 0])), "not exactly to the right"),
        (replace(flat, translation_m=np.array([0.1, 0, 0])), "not exactly to the right"),
        *((replace(flat, right=each), "principal points in different rows") for each in other),
    ):
        with pytest.raises(StereoweaveError, match=reason):
            unlike.camera()


def test_a_rig_whose_pixels_are_not_square_gives_a_camera_only_after_rectification():
    matrix = np.array([[800, 0, 99.5], [0, 400, 79.5], [0, 0, 1.0]])
    rig = calibration.make_rectified_rig(matrix, matrix, -0.1)
    with pytest.raises(StereoweaveError, match="found pixels that are not square; rectify the pictures"):
        rig.camera()
    assert rectify(pair_of(200, 160), rig).pair.camera.focal_px == 600  # the mean
    rounded = matrix + np.diag([0, 400.3, 0])
    assert calibration.make_rectified_rig(rounded, rounded, -0.1).camera().focal_px == 800


def test_the_rig_of_a_rectified_pair_is_written_and_gives_its_camera(tmp_path):
    camera = StereoCamera(focal_px=500, baseline_m=0.125, cx_px=310, cy_px=240, doffs_px=3)
    pair = replace(pair_of(640, 480), camera=camera)
    write_rig(tmp_path / "rig.yml", calibration.rectified_rig(pair))
    assert add_camera(pair_of(640, 480), tmp_path / "rig.yml").camera == camera
    with pytest.raises(StereoweaveError, match="camera is known"):
        calibration.rectified_rig(pair_of(640, 480))


def test_an_invalid_rig_is_refused():
    rig = rig_of(pinhole)
    for change in (
        {"rotation": -np.eye(3)},
        {"rotation": 1.001 * np.eye(3)},
        {"rotation": np.full((3, 3), np.nan)},
        {"translation_m": np.zeros(3)},
        {"translation_m": np.array([np.inf, 0, 0])},
        {"size_px": (0, 480)},
    ):
        with pytest.raises(StereoweaveError, match="expected"):
            replace(rig, **change)


@pytest.mark.parametrize("fisheye", [False, True])
def test_lenses_have_as_many_coefficients_as_the_models_of_opencv(fisheye):
    for count in (0, 4) if fisheye else (0, 4, 5, 8, 12, 14):
        Optics(matrix=np.eye(3), distortion=np.zeros(count), fisheye=fisheye)


@pytest.mark.parametrize(("count", "fisheye"), [(3, False), (6, False), (5, True)])
def test_coefficients_of_no_lens_are_refused(count, fisheye):
    with pytest.raises(StereoweaveError, match=f"found {count}"):
        Optics(matrix=np.eye(3), distortion=np.zeros(count), fisheye=fisheye)
