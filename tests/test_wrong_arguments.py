"""Every function of the Python interface accepts a wrong argument or refuses it with a one-line error."""

import inspect
import math
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import stereoweave as sw
from stereoweave import io
from stereoweave.errors import StereoweaveError
from stereoweave.io.arrays import as_rgb
from stereoweave.io.images import read_image
from stereoweave.rendering.renderer import Renderer

TEXTURED = Path(__file__).resolve().parent / "textured_pair"
LEFT, RIGHT = (
    np.ascontiguousarray(read_image(TEXTURED / f"{side}.png")[200:264, 200:296]) for side in ("left", "right")
)
# Large enough for a window of at least 32 px.
HALF_SPHERE = np.tile(LEFT, (4, 2, 1))
FLAT = np.full((64, 96), 3.0, np.float32)
FOUND = sw.Estimate(
    disparity_px=FLAT, right_disparity_px=FLAT, confidence=FLAT / 3, occluded=np.zeros((64, 96), bool)
)
PAIR = sw.StereoPair(left=LEFT, right=RIGHT)
CAMERA = sw.StereoCamera(focal_px=100.0, baseline_m=0.1, cx_px=48.0, cy_px=32.0)
MATCHER_FILE = cv2.FileStorage(
    "%YAML:1.0\n---\nmy_object:\n   P1: 5\n", cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY
)


def wrong_values() -> dict[str, Any]:
    """Return values that are wrong for all or most arguments."""
    return {
        "none": None,
        "true": True,
        "a word": "much",
        "no word": "",
        "bytes": b"small",
        "NaN": math.nan,
        "infinity": math.inf,
        "a fraction": 1.5,
        "a half of NumPy": np.float16(0.5),
        "a wide float of NumPy": np.longdouble(0.5),
        "a whole number of NumPy": np.int8(1),
        "a ratio": Fraction(1, 2),
        "a complex number": 1j,
        "minus one": -1,
        "2 ** 80": 2**80,
        "2 ** 2000": 2**2000,
        "a tuple of one": (5,),
        "a tuple of three": (1, 2, 3),
        "a tuple of words": ("a", "b"),
        "a list": [],
        "a ragged list": [1, (2, 3)],
        "a mapping": {},
        "an object": object(),
        "a kind": int,
        "an array": np.zeros((2, 2)),
        "an array of no dimension": np.array(3.0),
        "a matrix": np.matrix(LEFT[..., 0]),
        "a masked picture": np.ma.MaskedArray(LEFT, mask=LEFT > 100),
        "a picture of objects": LEFT.astype(object),
        "a picture of booleans": LEFT > 100,
        "a picture of texts": LEFT.astype(str),
        "a picture of times": LEFT.astype("datetime64[s]"),
        "a picture of complex numbers": LEFT.astype(complex),
        "a record array": np.zeros((64, 96), [("r", "u1"), ("g", "u1")]),
        "an empty picture": LEFT[:0],
        "floats": FLAT,
        "a picture of floats": LEFT / 255,
        "a picture of 16 bits": LEFT.astype(np.uint16),
        "a picture of two channels": LEFT[..., :2],
        "a masked map": np.ma.MaskedArray(FLAT, mask=FLAT > 0),
        "a matrix of floats": np.matrix(FLAT),
        "a map of objects": FLAT.astype(object),
        "another size": FLAT[:-1],
    }


class Call:
    """A call with valid arguments, which tests repeat with one argument replaced by a wrong one."""

    def __init__(self, name: str, call: Callable[..., Any], /, **right: Any) -> None:
        self.name, self.call, self.right = name, call, right


def calls() -> list[Call]:
    """Return calls of all functions, with keyword arguments."""
    matcher = sw.Matcher("small", threads=1)
    pair = {"left": LEFT, "right": RIGHT}
    maps = {name: getattr(FOUND, name) for name in ("disparity_px", "right_disparity_px")}
    maps |= {"confidence": FOUND.confidence, "occluded": FOUND.occluded}
    steps = {"refined": False, "raw": False}
    how = {"model": "small", "threads": 1, "provider": "cpu"}
    seen = np.ones((64, 96), bool)
    camera = {"focal_px": 100.0, "baseline_m": 0.1, "cx_px": 48.0, "cy_px": 32.0, "doffs_px": 0.0}
    opencv = sw.StereoMatcher(threads=1)
    sgbm = dict.fromkeys(list(inspect.signature(sw.StereoMatcher).parameters)[:11], 1)
    storage = cv2.FileStorage("all.yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    place = {"up": 0.1, "forward": 0.1}
    look = {"strength": 1.0, "convergence_px": 1.0}
    fine = LEFT.astype(np.float32), RIGHT.astype(np.float32)
    return [
        Call("estimate", sw.estimate, **pair, **how, **steps, range_px=(0, 20), align="auto"),
        Call(
            "estimate with a calibration",
            sw.estimate,
            left=TEXTURED / "left.png",
            right=TEXTURED / "right.png",
            calibration=TEXTURED / "calib.txt",
        ),
        Call("estimate of one file", sw.estimate, left=TEXTURED / "left.png", format="side_by_side"),
        Call(
            "estimate of a window",
            sw.estimate,
            left=HALF_SPHERE,
            right=HALF_SPHERE,
            **how,
            projection="fisheye",
            look_deg=(10.0, 0.0),
            fov_deg=60.0,
            lens_fov_deg=190.0,
        ),
        Call("Matcher", sw.Matcher, **how),
        Call("Matcher.estimate", matcher.estimate, **pair, **steps),
        Call("Matcher.estimate_many", matcher.estimate_many, pairs=[PAIR], **steps),
        Call("render", sw.render, **pair, estimate=FOUND, position=0.5, threads=1, **look, **place),
        Call("render with camera", sw.render, **pair, estimate=FOUND, position=0.5, up=0.1, camera=CAMERA),
        Call("Renderer", Renderer, pair=PAIR, estimate=FOUND, **look, threads=1, fine=fine),
        Call("Renderer.fine_view", Renderer(PAIR, FOUND, threads=1, fine=fine).fine_view, position=0.0),
        Call("Renderer.view", Renderer(PAIR, FOUND, threads=1).view, position=0.5, **place),
        Call("fit_screen", sw.fit_screen, estimate=FOUND, screen="phone", **look),
        Call("synthesize", sw.synthesize, **pair, position=0.5, **how),
        Call("StereoCamera", sw.StereoCamera, **camera),
        Call("StereoCamera.centred", sw.StereoCamera.centred, image=LEFT, focal_px=100.0, baseline_m=0.1),
        Call("StereoCamera.depth_m", CAMERA.depth_m, disparity_px=FLAT),
        Call("StereoCamera.disparity_px", CAMERA.disparity_px, depth_m=FLAT),
        Call("StereoPair", sw.StereoPair, **pair, camera=CAMERA, left_seen=seen, right_seen=seen),
        Call("Estimate", sw.Estimate, **maps, pair=PAIR, notes=()),
        Call("DepthCurve", sw.DepthCurve, exponent=1.5, max_disparity_px=192.0),
        Call("DepthCurve of depth", sw.DepthCurve, max_depth_m=10.0),
        Call("StereoMatcher", sw.StereoMatcher, **sgbm, min_confidence=0.5, refined=False, **how),
        Call("StereoMatcher.create", sw.StereoMatcher.create, **sgbm),
        Call("StereoMatcher.compute", opencv.compute, **pair, disparity=np.zeros((64, 96), np.int16)),
        Call("StereoMatcher.save", opencv.save, filename="matcher.yml"),
        Call("StereoMatcher.write", opencv.write, fs=storage, name="matcher"),
        Call("StereoMatcher.read", opencv.read, fn=MATCHER_FILE.getNode("my_object")),
        Call("StereoMatcher.setBlockSize", opencv.setBlockSize, blockSize=5),
        Call("StereoMatcher.setMinDisparity", opencv.setMinDisparity, minDisparity=0),
        Call("StereoMatcher.setROI1", opencv.setROI1, roi1=(0, 0, 96, 64)),
        Call("read_image", sw.read_image, path=TEXTURED / "left.png"),
        Call("read_pair", io.read_pair, left=TEXTURED / "left.png", right=TEXTURED / "right.png"),
        Call("write_image", io.write_image, path=Path("image.png"), image=LEFT),
        Call("write_pfm", io.write_pfm, path="map.pfm", values=FLAT),
        Call("read_pfm", io.read_pfm, path="map.pfm"),
        Call("write_npy", io.write_npy, path="map.npy", values=FLAT),
        Call("write_float_tiff", io.write_float_tiff, path="map.tiff", values=FLAT),
        Call("write_depth_png", io.write_depth_png, path="depth.png", depth_m=FLAT),
        Call("write_disparity_png", io.write_disparity_png, path="map.png", disparity_px=FLAT),
        Call("read_disparity_png", io.read_disparity_png, path="map.png"),
        Call("write_scaled_disparity_png", io.write_scaled_disparity_png, path="s.png", disparity_px=FLAT),
        Call("as_rgb", as_rgb, image=LEFT, name="picture"),
    ]


def outcome(call: Call, argument: str, value: Any) -> str | None:
    """Return what is wrong with the response to a wrong argument; None if the response is right."""
    try:
        call.call(**call.right | {argument: value})
    except StereoweaveError as error:
        lines = str(error).splitlines()
        return None if len(lines) == 1 and len(lines[0]) < 400 else f"{len(lines)} lines: {lines[0][:60]}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return None


@pytest.mark.usefixtures("without_shape_checks")
@pytest.mark.filterwarnings("ignore:the matrix subclass")
def test_a_wrong_argument_is_a_one_line_stereoweave_error(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # some names of files are wrong, but can be written
    wrong = []
    for call in calls():
        assert outcome(call, *next(iter(call.right.items()))) is None, call.name
        for argument in call.right:
            for name, value in wrong_values().items():
                if (found := outcome(call, argument, value)) is not None:
                    wrong.append(f"{call.name}({argument}={name}): {found}")
    assert not wrong, f"{len(wrong)}\n" + "\n".join(wrong)


def test_every_argument_of_the_interface_is_tested():
    tried = {call.name.split(" ")[0]: set(call.right) for call in calls()}
    for call in calls():
        tried[call.name.split(" ")[0]] |= set(call.right)
    functions = ("estimate", "fit_screen", "render", "synthesize", "read_image")
    for name in (*functions, "Matcher", "StereoCamera", "StereoMatcher", "StereoPair", "Estimate"):
        assert tried[name] == set(inspect.signature(getattr(sw, name)).parameters), name
    for name in set(io.__all__) - {"RangeError"}:
        assert tried[name] == set(inspect.signature(getattr(io, name)).parameters), name
    assert set(sw.__all__) - {name.split(".")[0] for name in tried} == {
        *("FormatError", "MatcherError", "StereoweaveError", "Sample", "View", "__version__")
    }
