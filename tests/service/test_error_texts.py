"""Errors and notes of the HTTP service, which name settings by their form fields."""

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
from error_examples import write_error_examples

from stereoweave.matching.matcher import Matcher
from stereoweave.service.answers import ServiceAnswer, ServiceJob, answer_many

# Pydantic warns about Ray Serve when that is imported.
pytestmark = pytest.mark.filterwarnings("ignore:Using extra keyword arguments on `Field`:DeprecationWarning")

PAIR = {"left": "left.png", "right": "right.png"}
LOWER = {"left": "upper.png", "right": "lower.png"}
Ask = Callable[..., httpx.Response]

ERRORS: dict[str, tuple[str, dict[str, str], dict[str, Any]]] = {
    "model: expected no such field; /openapi.json describes the fields": ("/view", PAIR, {"model": "base"}),
    "file: expected 'png' or 'jpg', found 'pfm'": ("/view", PAIR, {"file": "pfm"}),
    "strength: expected a number of at least 0, found '-1'": ("/view", PAIR, {"strength": -1}),
    "position: expected a number of at most 2, found '3'": ("/view", PAIR, {"position": 3}),
    "focal_px: expected a number above 0, found '0'; rectify: expected true or false, found 'perhaps'": (
        "/depth",
        PAIR,
        {"focal_px": 0, "rectify": "perhaps"},
    ),
    "baseline_m: expected a finite number, found 'inf'": ("/depth", PAIR, {"baseline_m": "inf"}),
    "position: expected a number, found 'left'": ("/view", PAIR, {"position": "left"}),
    "left: expected a file, found text": ("/view", {"right": "right.png"}, {"left": "left.png"}),
    "range: expected the least and the greatest disparity, such as -20,150, found 'wide'": (
        "/view",
        PAIR,
        {"range": "wide"},
    ),
    "picture: expected a stereo picture, two views side by side or one above the other, found what looks "
    "like a single photograph (its halves do not resemble each other); give two files, left and right; or "
    "choose its layout, such as side_by_side (format)": (
        "/disparity",
        {"picture": "left.png"},
        {},
    ),
    "format: expected one picture that holds both views, found two, left and right; omit this setting, "
    "and give the left picture first": ("/disparity", PAIR, {"format": "crossed"}),
    "calib: expected a calibration of rectified pictures, found lenses with distortion; rectify the pair "
    "with it (rectify)": ("/disparity", {**PAIR, "calib": "turned.yml"}, {}),
    "metres: expected a baseline besides the focal length, found none in metadata; give the baseline "
    "(baseline_m)": (
        "/depth",
        PAIR,
        {"focal_px": 500},
    ),
    "rectify: expected at least 40 feature matches that agree on the camera positions, found 0 of 0 "
    "matches; photograph a scene with more texture and with more overlap; or give a calibration (calib)": (
        "/view",
        {"left": "plain.png", "right": "plain.png"},
        {"rectify": True},
    ),
    "expected a camera for depth, found none; give a calibration, or the focal length and baseline of a "
    "rectified pair (calib, focal_px, baseline_m)": ("/depth", PAIR, {}),
    "range: expected disparities between -640 and 640 px, the width of the pictures, got 700 and 800; omit "
    "it for automatic detection": ("/disparity", PAIR, {"range": "700,800"}),
    "strength: expected views from -1 to 2 (0 is the left camera and 1 the right one), got 3.5 "
    "(position 2 at strength 2)": (
        "/view",
        PAIR,
        {"position": 2, "strength": 2},
    ),
}
NOTES: dict[str, tuple[dict[str, str], dict[str, Any]]] = {
    "the right picture is 2.0 px lower than the left one; rectify the pair (rectify)": (
        LOWER,
        {"check": True},
    ),
    "side_by_side, detected; override it if it is wrong (format)": (
        {"picture": "both.png"},
        {},
    ),
    "no depth in metres: rectification from feature matches did not find the cameras parallel; give a "
    "calibration (calib)": (
        {"left": "inwards_left.png", "right": "inwards_right.png"},
        {"focal_px": 640, "baseline_m": 0.1, "rectify": True},
    ),
}


@pytest.fixture(scope="module")
def ask(tmp_path_factory) -> Ask:
    """Return a function that posts a form with files and fields to a service in this process."""
    from stereoweave.service.asgi import Guard, Limits, make_app

    folder: Path = tmp_path_factory.mktemp("files")
    write_error_examples(folder)
    matcher = Matcher("small", threads=1)

    async def answer(job: ServiceJob, left_s: float) -> ServiceAnswer:
        (outcome,) = answer_many(matcher, [job])
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    limits = Limits()
    transport = httpx.ASGITransport(Guard(make_app(answer, limits, folder), limits))

    async def post(path: str, files: dict[str, str], fields: dict[str, Any]) -> httpx.Response:
        contents = {field: (folder / name).read_bytes() for field, name in files.items()}
        async with httpx.AsyncClient(transport=transport, base_url="http://service") as client:
            return await client.post(path, files=contents, data=fields)

    return lambda *asked: asyncio.run(post(*asked))


@pytest.mark.parametrize("text", ERRORS)
def test_an_error_names_settings_by_their_field(ask, text):
    response = ask(*ERRORS[text])
    assert response.status_code in (400, 422)
    assert response.json() == {"detail": text}


@pytest.mark.parametrize("text", NOTES)
def test_a_note_names_settings_by_their_field(ask, text):
    response = ask("/disparity", *NOTES[text])
    assert text in json.loads(response.headers["X-Stereoweave-Report"])["notes"]
