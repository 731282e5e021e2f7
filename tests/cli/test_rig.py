"""The commands check and rectify; calibrate is tested in test_calibrate.py, which has the boards."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereoweave.cameras.alignment import check_pair
from stereoweave.cameras.calibration_files import add_camera
from stereoweave.cli.root import main
from stereoweave.io.images import read_image, read_pair, write_image
from stereoweave.io.output_lock import lock_output

TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"
LEFT, RIGHT = str(TEXTURED / "left.png"), str(TEXTURED / "right.png")


@pytest.fixture
def turned(tmp_path) -> str:
    """Write the example's right picture as seen by a camera turned by 1 degree."""
    right = read_image(RIGHT)
    turn = cv2.getRotationMatrix2D((319.5, 239.5), 1.0, 1.0)
    write_image(
        tmp_path / "turned.png", cv2.warpAffine(right, turn, (640, 480), borderMode=cv2.BORDER_REFLECT)
    )
    return str(tmp_path / "turned.png")


def test_a_sound_pair_passes_the_check(capsys):
    assert main(["check", LEFT, RIGHT]) == 0
    assert "no defects" in capsys.readouterr().out


def test_swapped_pictures_fail_the_check_and_are_reported(capsys):
    assert main(["check", RIGHT, LEFT]) == 1
    assert "swapped; give them the other way round" in capsys.readouterr().out


def test_the_check_gives_its_numbers_as_json(turned, capsys):
    assert main(["check", LEFT, turned, "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["defects"] == ["rotation"]
    assert abs(found["rotation_degrees"]) == pytest.approx(1, abs=0.1)


def test_the_check_says_once_what_rectifies_a_pair(turned, tmp_path, capsys):
    picture = read_image(turned)
    write_image(tmp_path / "lower.png", np.roll(picture, 5, axis=0))
    assert main(["check", LEFT, str(tmp_path / "lower.png")]) == 1
    *lines, last = capsys.readouterr().out.splitlines()
    assert sum("right picture is" in line for line in lines) == 2
    assert "rectif" not in " ".join(lines)
    assert last == (
        "depth and view rectify such a pair by themselves; stereoweave rectify writes its pictures"
    )


def test_the_check_names_a_difference_in_exposure_once(tmp_path, capsys):
    write_image(tmp_path / "dark.png", (read_image(RIGHT) * 0.6).astype(np.uint8))
    assert main(["check", LEFT, str(tmp_path / "dark.png")]) == 1
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "exposure of" in line)
    assert line.startswith("the left picture has 3.1 times the exposure of the other")


def test_unknown_values_of_a_plain_pair_are_null_in_json(tmp_path, capsys):
    write_image(tmp_path / "plain.png", np.full((64, 96, 3), 90, np.uint8))
    assert main(["check", str(tmp_path / "plain.png"), str(tmp_path / "plain.png"), "--json"]) == 1
    found = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert found["defects"] == ["too_few_matches"]
    assert found["exposure_ratio"] is None


def test_a_pair_rectified_by_its_features_passes_the_check(turned, tmp_path, capsys):
    assert main(["rectify", LEFT, turned, "-o", str(tmp_path / "out")]) == 0
    names = ["left.png", "rectified.json", "right.png"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == names
    pair = read_pair(tmp_path / "out" / "left.png", tmp_path / "out" / "right.png")
    assert check_pair(pair.left, pair.right).defects == ()
    assert "rectified: rows are off by" in capsys.readouterr().out


def test_rectified_pictures_are_named_after_the_left_one_by_default(turned, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["rectify", LEFT, turned]) == 0
    described = json.loads(Path("left_rectified/rectified.json").read_text())
    assert described["sources"] == [LEFT, str(turned)]
    assert described["notes"][0].startswith("rectified: rows are off by")


def test_the_new_calibration_fits_the_new_pictures(tmp_path):
    out = tmp_path / "out"
    assert main(["rectify", LEFT, RIGHT, "--calib", str(TEXTURED / "calib.txt"), "-o", str(out)]) == 0
    pair = read_pair(out / "left.png", out / "right.png")
    assert add_camera(pair, out / "calib.yml").camera == add_camera(pair, TEXTURED / "calib.txt").camera


def test_rectification_does_not_overwrite_its_inputs(tmp_path, capsys):
    files = {name: tmp_path / name for name in ("left.png", "right.png", "calib.yml")}
    for path, source in zip(files.values(), (LEFT, RIGHT, TEXTURED / "calib.txt"), strict=True):
        path.write_bytes(Path(source).read_bytes())
    before = {name: path.read_bytes() for name, path in files.items()}
    pictures = [str(files["left.png"]), str(files["right.png"])]
    for words, named in (
        (pictures, "left.png"),
        ([LEFT, RIGHT, "--calib", str(files["calib.yml"])], "calib.yml"),
    ):
        assert main(["rectify", *words, "-o", str(tmp_path)]) == 2
        assert f"{files[named]}: expected" in capsys.readouterr().err
    assert {name: path.read_bytes() for name, path in files.items()} == before


def test_rectification_keeps_pictures_of_another_origin_and_replaces_its_own(tmp_path, capsys):
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    (theirs / "right.png").write_bytes(b"a photograph")
    assert main(["rectify", LEFT, RIGHT, "-o", str(theirs)]) == 2
    assert f"{theirs / 'right.png'}: expected no file, or one of an earlier" in capsys.readouterr().err
    assert [path.name for path in theirs.iterdir()] == ["right.png"]
    calibrated = ["--calib", str(TEXTURED / "calib.txt")]
    for words, has_calibration in ((calibrated, True), (calibrated, True), ([], False)):
        assert main(["rectify", LEFT, RIGHT, *words, "-o", str(tmp_path / "out")]) == 0
        assert (tmp_path / "out" / "calib.yml").exists() == has_calibration


def test_a_pair_is_not_rectified_into_a_folder_to_which_another_command_writes(tmp_path, capsys):
    with lock_output(tmp_path):
        assert main(["rectify", LEFT, RIGHT, "-o", str(tmp_path)]) == 2
    assert "found one that is in use" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_measurement_in_a_pair_out_of_line_says_so(turned, capsys):
    points = ["--from", "200,200", "--to", "400,300", "--focal-px", "600", "--baseline-m", "0.1"]
    assert main(["measure", LEFT, turned, *points, "--model", "small"]) == 0
    assert "rotated" in capsys.readouterr().out
    assert main(["measure", RIGHT, LEFT, *points, "--model", "small"]) == 2
    assert "left and right are swapped" in capsys.readouterr().err


def test_depth_and_view_rectify_a_pair_out_of_line_unless_told_otherwise(turned, tmp_path, capsys):
    # The network does not matter to what is said, and the default ones take long.
    quick = ["--model", "small"]
    assert main(["depth", LEFT, turned, "--no-rectify", "-o", str(tmp_path / "as_it_is"), *quick]) == 0
    assert "is rotated 1.0 degrees" in capsys.readouterr().out
    assert main(["depth", LEFT, turned, "-o", str(tmp_path / "mended"), *quick]) == 0
    printed = capsys.readouterr().out
    assert "is rotated" not in printed
    assert "; the pictures can also be kept as they are (--no-rectify)" in printed
    assert main(["view", LEFT, turned, "--no-rectify", "-o", str(tmp_path / "view.png"), *quick]) == 0
    assert "is rotated 1.0 degrees" in capsys.readouterr().out
    assert main(["view", LEFT, turned, "-o", str(tmp_path / "view.png"), *quick]) == 0
    assert "is rotated" not in capsys.readouterr().out
    # The borders that rectification leaves are cut off.
    assert np.array_equal(np.less(read_image(tmp_path / "view.png").shape[:2], (480, 640)), [True, True])
