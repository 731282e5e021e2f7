"""The file that was probably meant is named; pictures of other sides and numbers are not."""

from pathlib import Path

import pytest

from stereoweave.io.similar_names import describe_missing


@pytest.mark.parametrize(
    ("typed", "there"),
    [
        ("lef.png", "left.png"),
        ("leftt.png", "left.png"),
        ("rigth.png", "right.png"),
        ("Left.PNG", "left.png"),
        ("left.jpg", "left.png"),
        ("IMG_0001.jpeg", "IMG_0001.JPG"),
    ],
)
def test_a_slip_is_recognised(tmp_path, typed, there):
    (tmp_path / there).touch()
    assert describe_missing(tmp_path / typed) == f"no such file; did you mean {tmp_path / there}?"


@pytest.mark.parametrize(
    ("typed", "there"),
    [
        ("a_L.png", "a_R.png"),
        ("1.png", "2.png"),
        ("1.png", "11.png"),
        ("12.png", "21.png"),
        ("img1.png", "img10.png"),
        ("left.png", "right.png"),
        ("a.png", "b.png"),
    ],
)
def test_another_picture_is_not_suggested(tmp_path, typed, there):
    (tmp_path / there).touch()
    assert describe_missing(tmp_path / typed) == "no such file"


def test_a_folder_is_not_suggested_for_a_file(tmp_path):
    (tmp_path / "left").mkdir()
    assert describe_missing(tmp_path / "left.png") == "no such file"


def test_a_missing_folder_a_pattern_and_an_address_are_named(tmp_path):
    missing = tmp_path / "nowhere"
    assert describe_missing(missing / "left.png") == f"no such file, and no folder {missing}"
    assert describe_missing(tmp_path / "*.jpg") == "no file that matches"
    assert describe_missing(Path("https://example.org/left.jpg")) == (
        "an address; download the file first, because nothing is fetched"
    )
