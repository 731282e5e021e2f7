"""Error texts and notes of the Python interface name a setting by its keyword."""

import ast
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
from error_examples import LAYOUTS, write_error_examples

import stereoweave as sw
from stereoweave import errors
from stereoweave.cameras.alignment import Alignment, check_pair
from stereoweave.errors import Note, Remedy
from stereoweave.io.images import read_image
from stereoweave.io.maps import RangeError
from stereoweave.matching.options import MatchOptions
from stereoweave.outputs.point_cloud import EmptyError, require_camera
from stereoweave.pictures.loading import open_pictures
from stereoweave.pictures.pair_finding import find_pairs
from stereoweave.pictures.prepare import Request, prepare
from stereoweave.service.admission import BusyError
from stereoweave.service.answers import TooLargeError
from stereoweave.system.child_process import ProcessDiedError
from stereoweave.system.ray_engine import Engine
from stereoweave.video.job import VideoJob

PACKAGE = Path(sw.__file__).parent
PAIR = Path("left.png"), Path("right.png")
PLAIN = Path("plain.png"), Path("plain.png")
BLACK = np.zeros((64, 64, 3), np.uint8)
# Options of other programs
OTHERS = {
    "data/checksums.py": {"--check"},
    "data/paper_layout.py": {"--check"},
    "learn/checkpoint.py": {"--git-dir", "--always", "--dirty", "--exclude"},
    "learn/training/fabric.py": {"--nproc-per-node"},
    "learn/training/loop.py": {"--nproc-per-node"},
    "system/ray_engine.py": {"--address"},
}

ERRORS = {
    "left.png: expected a stereo picture, two views side by side or one above the other, found what "
    "looks like a single photograph (its halves do not resemble each other); give two files, left and right; "
    "or choose its layout, such as side_by_side (format)": lambda: open_pictures(PAIR[:1]),
    f"format: expected one of {LAYOUTS}, mpo, jps, found 'diagonal'": lambda: open_pictures(
        PAIR[:1], "diagonal"
    ),
    "format: expected one picture that holds both views, found two, left.png and right.png; omit this "
    "setting, and give the left picture first": lambda: open_pictures(PAIR, "crossed"),
    "turned.yml: expected a calibration of rectified pictures, found lenses with distortion; rectify "
    "the pair with it (rectify)": lambda: prepare(PAIR, Request(calibration=Path("turned.yml"))),
    "metres: expected a baseline besides the focal length, found none in metadata; give the baseline "
    "(baseline_m)": (lambda: prepare(PAIR, Request(focal_px=500))),
    "metres: expected a focal length besides the baseline, found none in metadata; give the focal length "
    "(focal_px)": lambda: prepare(PAIR, Request(baseline_m=0.1)),
    "rectify: expected at least 40 feature matches that agree on the camera positions, found 0 of 0 "
    "matches; photograph a scene with more texture and with more overlap; or give a calibration "
    "(calibration)": (lambda: prepare(PLAIN, Request(rectify=True))),
    "expected a camera for depth, found none; give a calibration, or the focal length and baseline of a "
    "rectified pair (calibration, focal_px, baseline_m)": (
        lambda: require_camera(sw.StereoPair(left=BLACK, right=BLACK))
    ),
    "raw: cannot be combined with refined, because raw output is not post-processed; leave one of them out "
    "(raw, refined)": (lambda: MatchOptions(raw=True, refined=True)),
    "expected pictures or a folder, patterns of left and right pictures, or a list of pairs, found none; "
    "give exactly one of them (left, right, listed)": lambda: find_pairs([], None, None, None),
    "provider: expected one of cpu, cuda, tensorrt, openvino, coreml, directml, found 'gpu'": (
        lambda: sw.Matcher(provider="gpu")
    ),
    "range_px: expected disparities between -64 and 64 px, the width of the pictures, got 70 and 80; omit it "
    "for automatic detection": lambda: sw.estimate(BLACK, BLACK, range_px=(70, 80)),
    "threads: expected a number from 1 to 1024, got 0": lambda: sw.Matcher(threads=0),
    "position: expected -1 to 2 (0 is the left camera and 1 the right one), got 3": (
        lambda: sw.synthesize(BLACK, BLACK, 3, threads=1)
    ),
    "expected one kind of output, found none; choose one (depth, depth10, depth16, position, "
    "layout)": VideoJob,
    "gpus_each: expected 0, a fraction below 1, or a whole number, found 1.5": lambda: Engine(gpus_each=1.5),
}


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    write_error_examples(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("text", ERRORS)
def test_an_error_names_settings_by_their_keyword(folder, text):
    with pytest.raises(sw.StereoweaveError) as caught:
        ERRORS[text]()
    assert str(caught.value) == text


def test_a_note_names_settings_by_their_keyword(folder):
    lower = check_pair(read_image("upper.png"), read_image("lower.png"))
    assert list(map(str, lower.warnings())) == [
        "the right picture is 2.0 px lower than the left one; rectify the pair (rectify)"
    ]
    assert list(map(str, open_pictures([Path("both.png")]).notes)) == [
        "side_by_side, detected; override it if it is wrong (format)"
    ]


def test_a_pair_with_different_exposures_is_advised_to_lock_them():
    brighter = Alignment(
        matches=500,
        vertical_error_px=0.1,
        vertical_error_95_px=0.3,
        vertical_shift_px=0.0,
        rotation_degrees=0.0,
        scale=1.0,
        range_px=(5.0, 60.0),
        negative_percent=0.0,
        exposure_ratio=2.0,
        defects=("exposure",),
    )
    assert list(map(str, brighter.warnings())) == [
        "the right picture has 2.0 times the exposure of the other: depth is less reliable where either "
        "picture is too dark or too bright; lock the exposure of both cameras"
    ]


@pytest.mark.parametrize(
    ("remedy", "text"),
    [
        (None, "two cameras"),
        (Remedy("turn one"), "two cameras; turn one"),
        (Remedy("rectify", ("rectify", "calibration")), "two cameras; rectify (R, C)"),
        (Remedy("rectify", ("rectify", "provider")), "two cameras; rectify (R)"),
        (Remedy("run it on cpu", ("provider",)), "two cameras"),
    ],
)
def test_a_remedy_whose_settings_a_front_end_lacks_is_left_out(remedy, text):
    names = {"rectify": "R", "calibration": "C"}
    assert Note("two cameras", remedy).format(names.get) == text
    assert sw.StereoweaveError("two cameras", remedy=remedy).format(names.get) == text
    assert (
        sw.StereoweaveError("two cameras", setting="rectify", remedy=remedy).format(names.get) == f"R: {text}"
    )
    assert sw.StereoweaveError("two", setting="provider").format(names.get) == "provider: two"


@pytest.mark.parametrize(
    "kind",
    [
        errors.StereoweaveError,
        errors.FormatError,
        errors.MatcherError,
        errors.ProviderError,
        errors.OutputInUseError,
        BusyError,
        EmptyError,
        ProcessDiedError,
        RangeError,
        TooLargeError,
    ],
)
def test_errors_cross_processes_with_setting_and_remedy(kind):
    error = kind("expected 1, found 2")
    error.setting, error.remedy = "rectify", Remedy("give a calibration", ("calibration",))
    there = pickle.loads(pickle.dumps(error))
    assert type(there) is kind
    assert str(there) == "rectify: expected 1, found 2; give a calibration (calibration)"
    assert vars(there) == vars(error)


def test_a_detail_is_inserted_before_the_remedy_and_keeps_the_class():
    error = errors.ProviderError("expected 1, found 2", remedy=Remedy("wait", ("threads",)))
    detailed = error.with_detail("parts are kept")
    assert type(detailed) is errors.ProviderError
    assert str(detailed) == "expected 1, found 2; parts are kept; wait (threads)"
    assert str(error) == "expected 1, found 2; wait (threads)"


def test_a_prefix_and_another_class_keep_the_setting_and_the_remedy():
    error = errors.StereoweaveError(
        "expected 1, found 2", setting="depth", remedy=Remedy("wait", ("threads",))
    )
    prefixed = errors.ProviderError.from_error(error).with_prefix("here: ")
    assert type(prefixed) is errors.ProviderError
    assert str(prefixed) == "depth: here: expected 1, found 2; wait (threads)"
    assert str(error) == "depth: expected 1, found 2; wait (threads)"
    assert str(errors.ProviderError.from_error(OSError("two\nlines"))) == "two lines"


def test_no_module_outside_the_command_line_spells_an_option():
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        strings = (
            node.value for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Constant)
        )
        text = "\n".join(string for string in strings if isinstance(string, str))
        options = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", text)) - OTHERS.get(name, set())
        if options and not name.startswith("cli/"):
            found[name] = options
    assert found == {}
