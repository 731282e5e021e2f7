"""Error texts and notes of the page name a setting by its label."""

import html
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from error_examples import write_error_examples
from page_examples import Visitor, file_data, start, stop
from video_examples import example_pairs, packed, write_video

from stereoweave.io.images import read_image, write_image

pytestmark = pytest.mark.system

PAIR = {"left": "left.png", "right": "right.png"}
Say = Callable[..., list[str]]
A_PICTURE = "expected a picture (PNG, JPEG, TIFF or the like), found"
A_VIDEO = "expected a video (MP4, MOV, MKV, WebM, AVI, MPEG, WMV, FLV or OGG), found"
A_CALIBRATION = (
    "expected a calibration of two cameras (OpenCV's YAML or XML, Kalibr's camchain, KITTI's or "
    "Middlebury's), found"
)
EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
MESSAGE = re.compile('class="(notice|warning)')
TWO_VIDEOS = {"video-left": "sbs.mp4", "video-right": "sbs.mp4"}

ERRORS: dict[str, tuple[dict[str, str], dict[str, Any]]] = {
    "left.png: expected a stereo picture, two views side by side or one above the other, found what "
    "looks like a single photograph (its halves do not resemble each other); give two files, left and right; "
    "or choose its layout, such as side by side (“Layout of a single file”)": ({"left": "left.png"}, {}),
    "“Layout of a single file”: expected one picture that holds both views, found two, left.png and "
    "right.png; omit this setting, and give the left picture first": (PAIR, {"layout": "crossed"}),
    "turned.yml: expected a calibration of rectified pictures, found lenses with distortion; rectify the "
    "pair with it (“Align the pictures”)": ({**PAIR, "calibration": "turned.yml"}, {"rectify": False}),
    "metres: expected a baseline besides the focal length, found none in metadata; give the baseline "
    "(“Baseline, mm”)": (
        PAIR,
        {"focal": 500},
    ),
    "metres: expected a focal length besides the baseline, found none in metadata; give the focal length "
    "(“Focal length, px”)": (PAIR, {"baseline": 100}),
    "expected a left and a right picture, or one file with both views, found none; drop them on the form, or "
    "try the sample": ({}, {}),
    f"notes.txt: {A_PICTURE} another type of file; save it as PNG or JPEG": (
        {"left": "notes.txt", "right": "right.png"},
        {},
    ),
    f"empty.png: {A_PICTURE} an empty file; copy it again": ({**PAIR, "right": "empty.png"}, {}),
    f"cut.png: {A_PICTURE} one that cannot be read (image file is truncated); copy it again": (
        {**PAIR, "left": "cut.png"},
        {},
    ),
    f"sbs.mp4: {A_PICTURE} a video; convert it as such (“Video”)": ({"left": "sbs.mp4"}, {}),
    "tiny.png: expected at least 32x32 pixels, found 20x20; give larger pictures": (
        {"left": "tiny.png", "right": "tiny.png"},
        {},
    ),
    "expected left and right pictures of the same size, found left.png with 640x480 and both.png with "
    "1280x480 pixels; crop or rescale one of them": ({**PAIR, "right": "both.png"}, {}),
    "expected left and right pictures of the same size, found left.png with 640x480 and upright.png with "
    "480x640 pixels; turn one of them upright": ({**PAIR, "right": "upright.png"}, {}),
    "“Focal length, px”: expected a number from 0 to 1,000,000, where 0 is unknown, found -500": (
        PAIR,
        {"focal": -500, "baseline": 100},
    ),
    "“Baseline, mm”: expected a number from 0 to 1,000,000, where 0 is unknown, found 1e+20": (
        PAIR,
        {"focal": 500, "baseline": 1e20},
    ),
    f"notes.txt: {A_CALIBRATION} one that cannot be read (no named entries); give another file, or none "
    "(“Calibration file, for metres”)": ({**PAIR, "calibration": "notes.txt"}, {}),
    "turned.yml: expected either a calibration or focal length and baseline, found both; omit one of them "
    "(“Calibration file, for metres”, “Focal length, px”, “Baseline, mm”)": (
        {**PAIR, "calibration": "turned.yml"},
        {"focal": 500, "baseline": 100},
    ),
}
VIDEO_ERRORS: dict[str, tuple[dict[str, str], dict[str, Any]]] = {
    "expected a video with both views, or a left and a right video, found none; drop it on the form": (
        {},
        {},
    ),
    f"left.png: {A_VIDEO} a picture; give it under “Pictures”": ({"video-left": "left.png"}, {}),
    f"notes.txt: {A_VIDEO} another kind of file, or a damaged one; copy it again, or save it as MP4": (
        {"video-left": "notes.txt"},
        {},
    ),
    "“Layout of a single video”: expected one video that holds both views, found two videos; choose "
    "detected, or give one video": (TWO_VIDEOS, {"video-layout": "side_by_side"}),
    "“Begin the preview at second”: expected a time from 0 s, the start, found -3 s": (
        {"video-left": "sbs.mp4"},
        {"video-start": -3},
    ),
    "expected a start within the video of 0:00:00.240, found 500 s; choose an earlier one": (
        {"video-left": "sbs.mp4"},
        {"video-start": 500, "video-layout": "side_by_side"},
    ),
}
NOTES: dict[str, tuple[dict[str, str], dict[str, Any]]] = {
    "side by side, detected; override it if it is wrong (“Layout of a single file”)": (
        {"left": "both.png"},
        {},
    ),
    "expected two pictures of the same scene, found ": ({**PAIR, "right": "unrelated.png"}, {}),
    "left and right show the same view: ": ({**PAIR, "right": "left.png"}, {}),
    "left and right were swapped, and have been swapped back": (
        {"left": "unrelated.png", "right": "ship_left.png"},
        {},
    ),
}


def write_mistakes(folder: Path) -> None:
    """Write files that a visitor may give by mistake, beside the examples that all front ends share."""
    write_error_examples(folder)
    left = read_image(folder / "left.png")
    (folder / "notes.txt").write_text("no picture", encoding="utf-8")
    (folder / "empty.png").touch()
    (folder / "cut.png").write_bytes((folder / "left.png").read_bytes()[:3000])
    write_image(folder / "tiny.png", left[:20, :20])
    write_image(folder / "upright.png", np.ascontiguousarray(np.rot90(left)))
    write_image(folder / "unrelated.png", read_image(EXAMPLES / "right.png"))
    write_image(folder / "ship_left.png", read_image(EXAMPLES / "left.png"))
    write_video(folder / "sbs.mp4", [packed(*pair) for pair in example_pairs(6)])


@pytest.fixture(scope="module")
def say(tmp_path_factory) -> Iterator[Say]:
    """Return a function that submits files and fields to the page and returns the lines of its notice."""
    folder = tmp_path_factory.mktemp("files")
    write_mistakes(folder)
    server, address = start(tmp_path_factory.mktemp("page"))

    def say(files: dict[str, str], fields: dict[str, Any], button: str = "find") -> list[str]:
        paths = visitor.upload(*(folder / name for name in files.values())) if files else []
        given = {field: file_data(path) for field, path in zip(files, paths, strict=True)}
        status, said = visitor.answer(visitor.press(button, **given, **fields))
        assert status == 200
        shown = next(part for part in json.loads(said)["data"] if MESSAGE.search(str(part)))
        return [html.unescape(line) for line in re.findall(r"<p>(.*?)</p>", str(shown))]

    with Visitor(address) as visitor:
        yield say
    stop(server)


@pytest.mark.parametrize("text", ERRORS)
def test_an_error_names_settings_by_their_label(say, text):
    assert say(*ERRORS[text]) == [text]


@pytest.mark.parametrize("button", ["video-preview", "video-look"])
@pytest.mark.parametrize("text", VIDEO_ERRORS)
def test_a_mistake_with_a_video_is_one_line(say, text, button):
    assert say(*VIDEO_ERRORS[text], button=button) == [text]


@pytest.mark.parametrize("text", NOTES)
def test_a_note_names_settings_by_their_label(say, text):
    assert any(line.startswith(text) for line in say(*NOTES[text]))


def test_an_aligned_pair_is_told_so_with_the_label_that_keeps_it(say):
    (line,) = [line for line in say({"left": "upper.png", "right": "lower.png"}, {}) if "rectified" in line]
    assert line.startswith("rectified: rows are off by ")
    assert line.endswith(
        "(2.00 px before); the pictures can also be kept as they are (untick “Align the pictures”)"
    )
