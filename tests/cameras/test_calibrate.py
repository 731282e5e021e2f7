import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image
from rig_examples import Cameras, Plane, fisheye, pinhole, rig_of, turned

from stereoweave.cameras import calibrate as calibration
from stereoweave.cameras.boards import (
    Board,
    ViewCorners,
    find_pair_corners,
    glance_at_chessboard,
    reorder_corners,
    shows_chessboard,
)
from stereoweave.cameras.calibrate import Calibration, calibrate, find_pairs
from stereoweave.cameras.calibration_files import read_rig, write_rig
from stereoweave.cli.root import main
from stereoweave.errors import StereoweaveError
from stereoweave.io.images import write_image

CHESSBOARD = Board(columns=9, rows=6, square_m=0.025)
CHARUCO = Board(columns=7, rows=5, square_m=0.04, marker_m=0.03, dictionary="DICT_4X4_50")
TEXEL_M = 0.001
# Position of the board's centre in metres, and its rotation in degrees about x, y and z.
POSES = [
    ((-0.14, -0.14, 0.70), (25, 20, 5)),
    ((0.05, -0.16, 0.65), (-25, 20, -8)),
    ((0.24, -0.14, 0.70), (20, -25, 3)),
    ((-0.14, 0.14, 0.70), (-20, -25, 10)),
    ((0.05, 0.16, 0.65), (30, 0, 0)),
    ((0.24, 0.14, 0.70), (-15, 25, -5)),
    ((-0.02, -0.04, 0.45), (0, 30, 4)),
    ((0.12, -0.04, 0.45), (15, -25, 8)),
    ((-0.02, 0.05, 0.45), (-30, 5, 2)),
    ((0.12, 0.05, 0.45), (30, 10, -3)),
]


def printed(board):
    """Return a picture of the board on a large white sheet."""
    side = round(board.square_m / TEXEL_M)
    if board.dictionary:
        picture = board.charuco().generateImage((board.columns * side, board.rows * side))
    else:
        rows, columns = np.mgrid[: board.rows + 1, : board.columns + 1]
        picture = np.kron(((rows + columns) % 2 * 255).astype(np.uint8), np.ones((side, side), np.uint8))
    sheet = cv2.copyMakeBorder(picture, *(4 * [600]), cv2.BORDER_CONSTANT, value=235)
    return np.repeat(sheet[..., None], 3, axis=2)


def take_pictures(folder, rig, board):
    cameras, sheet = Cameras(rig, samples=1), printed(board)
    for number, (middle_m, degrees) in enumerate(POSES):
        turn = turned(*degrees)
        pair = cameras.photograph([Plane(np.array(middle_m), turn[:, 0], turn[:, 1])], sheet, TEXEL_M)
        write_image(folder / "left" / f"{number:02}.png", pair.left)
        write_image(folder / "right" / f"{number:02}.png", pair.right)


@pytest.fixture(scope="module")
def charucos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("charuco")
    take_pictures(folder, rig_of(pinhole), CHARUCO)
    return folder


@pytest.fixture(scope="module")
def chessboards(tmp_path_factory):
    folder = tmp_path_factory.mktemp("chessboard")
    take_pictures(folder, rig_of(pinhole), CHESSBOARD)
    return folder


@pytest.fixture(
    scope="module",
    params=[(pinhole, CHESSBOARD), (pinhole, CHARUCO), (fisheye, CHESSBOARD), (fisheye, CHARUCO)],
)
def taken(request, tmp_path_factory, chessboards, charucos):
    """Return a folder of pictures, the board that they show, and the true rig that took them."""
    lens, board = request.param
    if lens == pinhole:
        return charucos if board == CHARUCO else chessboards, board, rig_of(lens)
    folder = tmp_path_factory.mktemp("boards")
    take_pictures(folder, rig_of(lens), board)
    return folder, board, rig_of(lens)


@pytest.fixture
def copied(charucos, tmp_path):
    return shutil.copytree(charucos, tmp_path / "pictures")


def test_the_rig_that_took_the_pictures_is_found(taken, tmp_path):
    folder, board, rig = taken
    found = calibrate(folder, board, fisheye=rig.left.fisheye)
    for one, other in ((found.rig.left, rig.left), (found.rig.right, rig.right)):
        np.testing.assert_allclose(np.diag(one.matrix), np.diag(other.matrix), rtol=0.005)
    assert found.rig.baseline_m == pytest.approx(rig.baseline_m, rel=0.005)
    off = cv2.Rodrigues(found.rig.rotation @ rig.rotation.T)[0]
    assert np.degrees(np.linalg.norm(off)) < 0.1
    assert found.error_px < 0.3 and found.epipolar_error_px < 0.15
    assert len(found.used) >= 9
    write_rig(tmp_path / "rig.yml", found.rig)
    np.testing.assert_array_equal(read_rig(tmp_path / "rig.yml").right.matrix, found.rig.right.matrix)


def test_results_are_reported_in_plain_words(charucos):
    told = calibrate(charucos, CHARUCO).lines()
    assert told[0].startswith("left camera: focal length 5") and told[0].endswith("640x480 px")
    assert "rotated by 2.6" in told[1]
    assert "reprojection error 0." in told[2]
    assert told[-1].startswith("fair: corners cover only") and "px over 10 pairs)" in told[-1]


def test_the_command_writes_the_calibration_and_says_how_good_it_is(charucos, tmp_path, capsys):
    out = tmp_path / "new" / "rig.yml"
    board = ["--board", "7x5", "--square-mm", "40", "--charuco", "DICT_4X4_50", "--marker-mm", "30"]
    assert main(["calibrate", str(charucos), *board, "-o", str(out)]) == 0
    assert read_rig(out).baseline_m == pytest.approx(0.1, rel=0.005)
    told = capsys.readouterr().out
    assert told.startswith(f"{out}: ") and "reprojection error 0." in told
    assert main(["calibrate", str(charucos), *board, "--board", "seven", "-o", str(out)]) == 2
    assert "such as 9x6" in capsys.readouterr().err


def test_a_bad_pair_is_named_and_the_rest_go_on(copied):
    shutil.copy(copied / "left" / "03.png", copied / "left" / "99.png")
    Image.fromarray(np.full((480, 640, 3), 90, np.uint8)).save(copied / "right" / "01.png")
    (copied / "left" / "02.png").write_bytes((copied / "left" / "02.png").read_bytes()[:3000])
    with Image.open(copied / "right" / "04.png") as picture:
        smaller = picture.resize((320, 240))
    smaller.save(copied / "right" / "04.png")
    found = calibrate(copied, CHARUCO)
    assert set(found.left_out) == {f"left/{number}.png" for number in ("01", "02", "04", "99")}
    assert "no board was detected in the right picture" in found.left_out["left/01.png"]
    assert "02.png" in found.left_out["left/02.png"]
    assert "left picture has 640x480 pixels, but the right one has 320x240" in found.left_out["left/04.png"]
    assert "the picture of the other camera is missing" in found.left_out["left/99.png"]
    assert len(found.used) == 7
    assert found.rig.baseline_m == pytest.approx(0.1, rel=0.02)
    assert "left/01.png: left out, no board" in "\n".join(found.lines())


def test_a_pair_in_motion_is_dropped(copied):
    with Image.open(copied / "right" / "05.png") as picture:
        shifted = np.roll(np.asarray(picture), 6, axis=0)
    Image.fromarray(shifted).save(copied / "right" / "05.png")
    found = calibrate(copied, CHARUCO)
    assert list(found.left_out) == ["left/05.png"]
    assert "times the median of all pairs" in found.left_out["left/05.png"]


def test_pairs_of_another_size_than_most_are_left_out(copied):
    for side in ("left", "right"):
        with Image.open(copied / side / "08.png") as picture:
            larger = picture.resize((1280, 960))
        larger.save(copied / side / "08.png")
    found = calibrate(copied, CHARUCO)
    assert found.left_out == {"left/08.png": "size 1280x960, but most pairs have 640x480"}


@pytest.mark.parametrize(
    "names",
    [
        ("left{}.png", "right{}.png"),
        ("{}_L.png", "{}_R.png"),
        ("cam0/{}.png", "cam1/{}.png"),
        ("imgLeft{}.png", "imgRight{}.png"),
        ("board_l_{}.png", "board_r_{}.jpg"),
        ("L{}.png", "R{}.png"),
    ],
)
def test_pairs_are_known_by_their_names(tmp_path, names):
    for name in names:
        for number in ("01", "02"):
            path = tmp_path / name.format(number)
            path.parent.mkdir(exist_ok=True)
            path.touch()
    for name in ("notes.txt", "._01_L.png"):  # macOS writes hidden files beside pictures
        (tmp_path / name).touch()
    pairs, left_out = find_pairs(tmp_path)
    assert [[str(path.relative_to(tmp_path)) for path in pair] for pair in pairs.values()] == [
        [name.format(number) for name in names] for number in ("01", "02")
    ]
    assert left_out == {}


def test_a_second_picture_of_a_view_is_left_out_by_name(tmp_path):
    for name in ("left/01.jpg", "left/01.png", "right/01.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    pairs, left_out = find_pairs(tmp_path)
    assert pairs == {"left/01.jpg": (tmp_path / "left" / "01.jpg", tmp_path / "right" / "01.png")}
    assert left_out == {"left/01.png": "01.jpg is a picture of the same view"}


def test_a_picture_without_partner_is_left_out_by_name(tmp_path):
    for name in ("1_L.png", "1_R.png", "2_R.png"):
        (tmp_path / name).touch()
    pairs, left_out = find_pairs(tmp_path)
    assert list(pairs) == ["1_L.png"]
    assert left_out == {"2_R.png": "the picture of the other camera is missing"}


@pytest.mark.parametrize("name", ["CharucoBoard", "DICT_9X9_50"])
def test_an_unknown_dictionary_is_refused_with_the_known_ones(name):
    with pytest.raises(StereoweaveError, match=f"unknown marker dictionary {name}; expected .*DICT_5X5_100"):
        replace(CHARUCO, dictionary=name)


def test_another_board_than_the_one_named_is_refused(charucos):
    other = replace(CHARUCO, dictionary="DICT_6X6_50")
    with pytest.raises(
        StereoweaveError, match=r"7x5 squares \(DICT_6X6_50\) .* found it in 0 of 10"
    ) as caught:
        calibrate(charucos, other)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("given", ["8x6", "10x7", "5x4"])
def test_a_chessboard_with_other_numbers_of_corners_is_named(chessboards, tmp_path, capsys, given):
    out = tmp_path / "rig.yml"
    assert main(["calibrate", str(chessboards), "--board", given, "--square-mm", "25", "-o", str(out)]) == 2
    assert capsys.readouterr().err == (
        f"stereoweave: --board: expected a chessboard of {given} inner corners, found one of 9x6 in 12 of 12 "
        "pictures; count the inner corners, where four squares meet\n"
    )
    assert not out.exists()


def test_pictures_without_a_board_are_refused_after_a_few_of_them(tmp_path, monkeypatch):
    for number in range(20):
        for side in ("left", "right"):
            write_image(tmp_path / f"{side}{number:02}.png", np.full((64, 96, 3), 90, np.uint8))
    opened = []
    read = calibration.read_image
    monkeypatch.setattr(calibration, "read_image", lambda path: opened.append(path.stem) or read(path))
    with pytest.raises(
        StereoweaveError, match="found none in 8 of 40 pictures, spread over the folder; take"
    ):
        calibrate(tmp_path, CHESSBOARD)
    # Every second one of the six pairs 0, 4, 8, 11, 15 and 19, and then the second of them.
    assert opened == [f"{side}{number}" for number in ("00", "08", "15", "04") for side in ("left", "right")]


def test_a_board_that_is_too_small_for_a_glance_is_found_at_full_size():
    image = np.full((2000, 3000), 200, np.uint8)
    squares = np.kron(np.indices((7, 10)).sum(axis=0) % 2, np.ones((8, 8)))
    image[900:956, 1300:1380] = 40 + 170 * squares
    assert glance_at_chessboard(image, CHESSBOARD) is None
    assert shows_chessboard(image, CHESSBOARD)
    assert not shows_chessboard(image[:800], CHESSBOARD)


def test_the_search_in_every_picture_has_a_line_in_a_log(chessboards, tmp_path, capsys):
    arguments = ["--board", "9x6", "--square-mm", "25", "-o", str(tmp_path / "rig.yml")]
    assert main(["calibrate", str(chessboards), *arguments]) == 0
    assert "finding the board …\n" in capsys.readouterr().err


def test_corners_in_a_large_picture_are_as_precise_as_in_the_search_of_all_its_pixels():
    sheet = np.full((1500, 2000), 235, np.uint8)
    rows, columns = np.mgrid[:7, :10]
    sheet[300:860, 400:1200] = np.kron(((rows + columns) % 2 * 255).astype(np.uint8), np.ones((80, 80)))
    tilted = np.array([[0.9, 0.2, 31.3], [-0.1, 0.8, 210.7], [1e-5, 5e-5, 1]])
    left = cv2.GaussianBlur(cv2.warpPerspective(sheet, tilted, (2000, 1500), borderValue=235), (0, 0), 1)
    found = find_pair_corners("sheet", left, left, CHESSBOARD)
    # The corners of the squares lie between two pixels.
    across, down = np.meshgrid(400 + 80 * np.arange(1, 10) - 0.5, 300 + 80 * np.arange(1, 7) - 0.5)
    true_px = cv2.perspectiveTransform(np.dstack([across, down]).reshape(-1, 1, 2), tilted).reshape(-1, 2)
    off_px = [np.linalg.norm(found.left_px - places, axis=1).max() for places in (true_px, true_px[::-1])]
    assert min(off_px) < 0.1


def test_too_few_pairs_are_refused(copied):
    for number in range(4, 10):
        (copied / "left" / f"{number:02}.png").unlink()
    with pytest.raises(StereoweaveError, match="at least 5 pairs, found it in 4 of 4"):
        calibrate(copied, CHARUCO)


@pytest.mark.parametrize("name", ["nowhere", "empty"])
def test_a_folder_without_pairs_is_refused(tmp_path, name):
    (tmp_path / "empty").mkdir()
    with pytest.raises(StereoweaveError, match=f"{name}: expected .*, found (none|no such folder)"):
        calibrate(tmp_path / name, CHESSBOARD)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"columns": 2}, "at least 3x3"),
        ({"square_m": 0.0}, "0 mm"),
        ({"marker_m": 0.02}, "both the dictionary"),
        ({"marker_m": 0.03, "dictionary": "DICT_4X4_50"}, "smaller than the squares"),
        ({"marker_m": 0.02, "dictionary": "DICT_9X9_50"}, "expected one of DICT_4X4"),
    ],
)
def test_an_invalid_board_is_refused(change, said):
    with pytest.raises(StereoweaveError, match=said):
        replace(CHESSBOARD, **change)


def judged(**change):
    """Return the verdict on a sound calibration with some fields changed."""
    sound = {
        "rig": rig_of(pinhole),
        "left_error_px": 0.2,
        "right_error_px": 0.2,
        "epipolar_error_px": 0.1,
        "cover_percent": 80.0,
        "tilt_degrees": 30.0,
        "used": tuple(f"{number}.png" for number in range(18)),
        "left_out": {},
    }
    return Calibration(**(sound | change)).verdict


def test_the_verdict_says_how_good_it_is_and_what_to_do():
    assert judged() == "good: 0.20 px over 18 pairs"
    # A small error is not what makes a calibration poor.
    assert judged(cover_percent=50.0).startswith("fair: corners cover only 50 %")
    assert judged(cover_percent=30.0) == (
        "poor: corners cover only 30 % of the picture: add pictures with the board near the edges "
        "(0.20 px over 18 pairs)"
    )
    # The root mean square of 0.6 and 0.8 is 0.71; the one of 1 and 2 is 1.58.
    assert judged(left_error_px=0.6, right_error_px=0.8).endswith("(0.71 px over 18 pairs)")
    assert judged(left_error_px=0.6, right_error_px=0.8).startswith("fair: the reprojection error is large")
    assert judged(left_error_px=1.0, right_error_px=2.0).startswith("poor: the reprojection error is large")
    assert judged(left_error_px=1.0, right_error_px=2.0).endswith("(1.58 px over 18 pairs)")
    assert judged(tilt_degrees=5.0).startswith("poor") and "tilted board" in judged(tilt_degrees=5.0)
    assert judged(used=("1.png",) * 6).startswith("fair")
    swapped = replace(rig_of(pinhole), translation_m=np.array([0.1, 0, 0]))
    assert judged(rig=swapped).startswith("poor: left and right pictures are swapped: rename them")


def test_pictures_that_do_not_determine_the_lens_are_refused_in_one_line(tmp_path):
    # All pictures are the same, with a board in the middle that is not tilted.
    flat = Plane(np.array([0.02, 0, 0.8]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]))
    pair = Cameras(rig_of(fisheye), samples=1).photograph([flat], printed(CHARUCO), TEXEL_M)
    for number in range(5):
        write_image(tmp_path / f"left{number}.png", pair.left)
        write_image(tmp_path / f"right{number}.png", pair.right)
    with pytest.raises(StereoweaveError, match="5 pairs for which OpenCV fails") as caught:
        calibrate(tmp_path, CHARUCO, fisheye=True)
    assert "\n" not in str(caught.value)


def test_a_chessboard_that_was_counted_from_another_corner_is_turned_back():
    square = Board(columns=4, rows=4, square_m=0.02)
    for board, turns in ((CHESSBOARD, (0, 2)), (square, (0, 1, 2, 3))):
        left_px = board.corners_m()[:, :2] * 1000
        numbers = np.arange(len(left_px))
        for turn in turns:
            grid = (left_px - (40, 3)).reshape(board.rows, board.columns, 2)
            there = ViewCorners(numbers, np.rot90(grid, turn).reshape(-1, 2))
            ordered = reorder_corners(ViewCorners(numbers, left_px), there, board)
            np.testing.assert_allclose(ordered.at_px, left_px - (40, 3))
