"""Error texts and notes of the page name a setting by its label."""

import html
import json
import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from error_examples import LAYOUTS, write_error_examples
from page_examples import Visitor, file_data, start, stop

pytestmark = pytest.mark.system

PAIR = {"left": "left.png", "right": "right.png"}
Say = Callable[..., list[str]]

ERRORS: dict[str, tuple[dict[str, str], dict[str, Any]]] = {
    "left.png: expected a stereo picture, two views side by side or one above the other, found what "
    "looks like a single photograph (its halves do not resemble each other); give two files, left and right; "
    "or choose one of "
    f"{LAYOUTS} (“Layout of a single file”)": ({"left": "left.png"}, {}),
    "“Layout of a single file”: expected one picture that holds both views, found two, left.png and "
    "right.png; omit this setting, and give the left picture first": (PAIR, {"layout": "crossed"}),
    "turned.yml: expected a calibration of rectified pictures, found lenses with distortion; rectify the "
    "pair with it (“Align the pictures”)": ({**PAIR, "calibration": "turned.yml"}, {"rectify": False}),
    "metres: expected a baseline besides the focal length, found none in EXIF; give the baseline "
    "(“Baseline, mm”)": (
        PAIR,
        {"focal": 500},
    ),
    "metres: expected a focal length besides the baseline, found none in EXIF; give the focal length "
    "(“Focal length, px”)": (PAIR, {"baseline": 100}),
}
NOTES: dict[str, tuple[dict[str, str], dict[str, Any]]] = {
    "side_by_side, detected from name and content; override it if it is wrong (“Layout of a single file”)": (
        {"left": "both.png"},
        {},
    ),
}


@pytest.fixture(scope="module")
def say(tmp_path_factory) -> Iterator[Say]:
    """Return a function that submits files and fields to the page and returns the lines of its notice."""
    folder = tmp_path_factory.mktemp("files")
    write_error_examples(folder)
    server, address = start(tmp_path_factory.mktemp("page"))

    def say(files: dict[str, str], fields: dict[str, Any]) -> list[str]:
        paths = visitor.upload(*(folder / name for name in files.values()))
        given = {field: file_data(path) for field, path in zip(files, paths, strict=True)}
        status, said = visitor.answer(visitor.press(**given, **fields))
        assert status == 200
        shown = next(part for part in json.loads(said)["data"] if 'class="notice' in str(part))
        return [html.unescape(line) for line in re.findall(r"<p>(.*?)</p>", str(shown))]

    with Visitor(address) as visitor:
        yield say
    stop(server)


@pytest.mark.parametrize("text", ERRORS)
def test_an_error_names_settings_by_their_label(say, text):
    assert say(*ERRORS[text]) == [text]


@pytest.mark.parametrize("text", NOTES)
def test_a_note_names_settings_by_their_label(say, text):
    assert text in say(*NOTES[text])


def test_an_aligned_pair_is_told_so_with_the_label_that_keeps_it(say):
    (line,) = [line for line in say({"left": "upper.png", "right": "lower.png"}, {}) if "rectified" in line]
    assert line.startswith("rectified with ")
    assert line.endswith("(2.00 px before); keep the pictures as they are (“Align the pictures”)")
