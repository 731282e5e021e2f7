"""The scripts in examples/ run as a user would run them, and the messages of the ROS 2 node are correct."""

import importlib.util
import re
import runpy
import struct
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from stereoweave.io.images import read_image
from stereoweave.io.maps import read_pixels
from stereoweave.stereo import Estimate, StereoCamera

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


@pytest.fixture
def run(tmp_path, monkeypatch, capsys) -> Callable[..., str]:
    """Return a function that runs a script with arguments in an empty folder and returns its output."""
    monkeypatch.chdir(tmp_path)

    def ran(script: str, *words: str) -> str:
        monkeypatch.setattr(sys, "argv", [script, *words])
        runpy.run_path(str(EXAMPLES / script), run_name="__main__")
        said, complaint = capsys.readouterr()
        assert complaint == ""
        return said

    return ran


def test_a_script_needs_nothing_but_the_package(tmp_path):
    done = subprocess.run(
        [sys.executable, "-W", "error", EXAMPLES / "measure.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("from (262, 225) to (390, 215): ")


def numbers(text: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?", text)]


def test_depth_of_a_pair(run, tmp_path):
    said = run("depth_of_a_pair.py")
    depth_mm = read_pixels(tmp_path / "depth.png", "I;16")
    assert depth_mm.shape == (480, 640)
    # The bow and the water in front of it are 3.5 to 5 m away. The sky is too far for 16 bits, so it is 0.
    ground_m = depth_mm[300:] / 1000
    assert 3 < np.percentile(ground_m, 1) < np.percentile(ground_m, 50) < 6
    assert (depth_mm[:50] == 0).mean() > 0.5
    in_the_middle_m, sure_percent = numbers(said)
    assert in_the_middle_m == pytest.approx(depth_mm[240, 320] / 1000, abs=0.006)
    assert 80 < sure_percent <= 100
    assert read_image(tmp_path / "disparity.png").shape == (480, 640, 3)


def test_new_views(run, tmp_path):
    assert numbers(run("new_views.py"))[0] > 95
    for name in ("middle.png", "wider.png"):
        assert read_image(tmp_path / name).shape == (480, 640, 3)
    with Image.open(tmp_path / "wiggle.gif") as wiggle:
        assert (wiggle.n_frames, wiggle.size) == (10, (640, 480))  # type: ignore[attr-defined]


def test_point_cloud(run, tmp_path):
    count, near_m, far_m = numbers(run("point_cloud.py"))
    assert len(trimesh.load(tmp_path / "points.ply").vertices) == count > 190_000
    assert near_m == pytest.approx(3.55, abs=0.1)  # the nearest water, as rendered
    assert far_m > 15  # the hills
    assert len(trimesh.load(tmp_path / "surface.glb", force="mesh").faces) > 200_000


def test_measure(run):
    *_, distance_m, uncertainty_m, percent = numbers(run("measure.py"))
    assert percent == 68
    assert 0 < uncertainty_m < 0.3
    # Between the rendered points (-0.816, -0.206, 6.814) and (1.064, -0.370, 7.244) m.
    assert distance_m == pytest.approx(1.936, abs=2 * uncertainty_m)
    *_, others_m, _, _ = numbers(run("measure.py", "130", "380", "440", "225"))
    assert others_m > distance_m


def test_replace_sgbm(run, tmp_path):
    percent, beyond_m = numbers(run("replace_sgbm.py"))
    points_m = np.load(tmp_path / "points.npy")
    assert len(points_m) == pytest.approx(percent / 100 * 640 * 480, rel=0.01)
    assert np.median(points_m[:, 2]) == pytest.approx(beyond_m, abs=0.006)


def test_depth_of_a_video(run, tmp_path):
    left, right = (cv2.imread(str(EXAMPLES / name)) for name in ("left.png", "right.png"))
    frame = cv2.resize(np.hstack([left, right]), (320, 120), interpolation=cv2.INTER_AREA)
    film = cv2.VideoWriter(str(tmp_path / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25, (320, 120))
    for _ in range(3):
        film.write(frame)
    film.release()
    assert run("depth_of_a_video.py", "film.avi") == "3 frames\n"
    made = cv2.VideoCapture(str(tmp_path / "depth.mp4"))
    assert made.get(cv2.CAP_PROP_FRAME_COUNT) == 3
    _, first = made.read()
    assert first.shape == (120, 160, 3)


def test_depth_of_a_video_without_a_video_says_how_to_give_one(run):
    with pytest.raises(SystemExit, match=r"^usage: python depth_of_a_video\.py FILM\.mp4"):
        run("depth_of_a_video.py")


def test_torch_tensors(run, tmp_path):
    assert run("torch_tensors.py").startswith("features [1, 5, 480, 640]")
    features = torch.load(tmp_path / "features.pt")
    left = read_image(EXAMPLES / "left.png")
    np.testing.assert_allclose(features[0, :3].permute(1, 2, 0) * 255, left, atol=1e-3)
    assert 0 <= features[0, 4].min() <= features[0, 4].max() <= 1


def test_each_script_is_short_documented_and_run_in_these_tests():
    for script in EXAMPLES.glob("*.py"):
        text = script.read_text(encoding="utf-8")
        assert len(text.splitlines()) < 45
        assert text.startswith('"""')
        assert f"Run: python examples/{script.name}" in text
        assert f"def test_{script.stem}(" in Path(__file__).read_text(encoding="utf-8")


# The messages, with the fields of ROS 2's definitions (std_msgs, sensor_msgs, stereo_msgs).


@dataclass
class Header:
    frame_id: str = ""


@dataclass
class ImageMessage:
    header: Header = field(default_factory=Header)
    height: int = 0
    width: int = 0
    encoding: str = ""
    is_bigendian: int = 0
    step: int = 0
    data: object = b""

    def __setattr__(self, name: str, value: object) -> None:
        set_known(self, name, value)


@dataclass
class RegionOfInterest:
    x_offset: int = 0
    y_offset: int = 0
    height: int = 0
    width: int = 0
    do_rectify: bool = True

    def __setattr__(self, name: str, value: object) -> None:
        set_known(self, name, value)


@dataclass
class DisparityImage:
    header: Header = field(default_factory=Header)
    image: ImageMessage = field(default_factory=ImageMessage)
    f: float = 0.0
    t: float = 0.0
    valid_window: RegionOfInterest = field(default_factory=RegionOfInterest)
    min_disparity: float = 0.0
    max_disparity: float = 0.0
    delta_d: float = 0.0

    def __setattr__(self, name: str, value: object) -> None:
        set_known(self, name, value)


@dataclass
class PointField:
    name: str = ""
    offset: int = 0
    datatype: int = 0
    count: int = 0

    def __setattr__(self, name: str, value: object) -> None:
        set_known(self, name, value)


@dataclass
class PointCloud2:
    header: Header = field(default_factory=Header)
    height: int = 0
    width: int = 0
    fields: list = field(default_factory=list)
    is_bigendian: bool = True
    point_step: int = 0
    row_step: int = 0
    data: object = b""
    is_dense: bool = True

    def __setattr__(self, name: str, value: object) -> None:
        set_known(self, name, value)


@dataclass
class CameraInfo:
    p: list[float]


def set_known(message: object, name: str, value: object) -> None:
    """Set a field as ROS's messages do: unknown fields and NumPy numbers are refused."""
    assert name in type(message).__dataclass_fields__  # type: ignore[attr-defined]
    assert not isinstance(value, np.generic)
    object.__setattr__(message, name, value)


@pytest.fixture(scope="module")
def conversions() -> ModuleType:
    specification = importlib.util.spec_from_file_location(
        "conversions", EXAMPLES / "ros2" / "conversions.py"
    )
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


CAMERA = StereoCamera(focal_px=100, baseline_m=0.5, cx_px=1, cy_px=0, doffs_px=2)
HEADER = Header(frame_id="left_optical")


def estimate_of_two_rows() -> Estimate:
    """Return an estimate with a pixel of low confidence, one at infinity and an occluded one."""
    return Estimate(
        disparity_px=np.array([[8, 3, 23], [-2, 8, 8]], np.float32),
        right_disparity_px=np.zeros((2, 3), np.float32),
        confidence=np.array([[0.9, 0.2, 0.9], [0.9, 0.9, 0.9]], np.float32),
        occluded=np.array([[False, False, False], [False, True, False]]),
    )


# f B / (d + doffs): 50 / 10, unknown, 50 / 25; infinite, unknown, 50 / 10.
DEPTH_M = [[5, np.nan, 2], [np.inf, np.nan, 5]]


@pytest.mark.parametrize(
    ("encoding", "pixel"),
    [
        ("rgb8", [1, 2, 3]),
        ("bgr8", [3, 2, 1]),
        ("rgba8", [1, 2, 3, 9]),
        ("bgra8", [3, 2, 1, 9]),
        ("mono8", [7]),
    ],
)
def test_an_image_is_read_from_a_message_of_any_encoding(conversions, encoding, pixel):
    rows = bytes(4 * pixel) + b"padding", bytes(4 * pixel) + b"padding"
    message = ImageMessage(
        height=2, width=4, encoding=encoding, step=4 * len(pixel) + 7, data=rows[0] + rows[1]
    )
    rgb = conversions.rgb_of(message)
    assert rgb.shape == (2, 4, 3)
    assert (rgb == ([7, 7, 7] if encoding == "mono8" else [1, 2, 3])).all()


def test_an_unknown_encoding_is_named(conversions):
    with pytest.raises(ValueError, match="found 'bayer_rggb8'"):
        conversions.rgb_of(ImageMessage(encoding="bayer_rggb8"))


def test_the_camera_comes_from_both_projection_matrices(conversions):
    left = CameraInfo(p=[100, 0, 1, 0, 0, 100, 0, 0, 0, 0, 1, 0])
    right = CameraInfo(p=[100, 0, 3, -50, 0, 100, 0, 0, 0, 0, 1, 0])
    assert conversions.camera_of(left, right) == CAMERA
    for first, second in ((right, left), (CameraInfo(p=12 * [0.0]), right)):
        with pytest.raises(ValueError, match="calibrated stereo pair"):
            conversions.camera_of(first, second)


def test_depth_is_metres_nan_where_unknown_and_infinite_where_too_far(conversions):
    estimate = estimate_of_two_rows()
    depth_m = conversions.depth_of(estimate, CAMERA, conversions.known_of(estimate, 0.5))
    message = ImageMessage()
    conversions.fill_image(message, HEADER, depth_m)
    assert message.header is HEADER
    assert (message.height, message.width, message.encoding, message.step) == (2, 3, "32FC1", 12)
    np.testing.assert_array_equal(struct.unpack("<6f", message.data), np.ravel(DEPTH_M))


def test_the_disparity_message_gives_the_depth_by_its_own_formula(conversions):
    estimate, message = estimate_of_two_rows(), DisparityImage()
    known = conversions.known_of(estimate, 0.5)
    conversions.fill_disparity(message, HEADER, estimate, CAMERA, known, (0, 20))
    assert message.header is message.image.header is HEADER
    assert (message.min_disparity, message.max_disparity) == (2, 22)  # plus doffs
    disparity_px = np.array(struct.unpack("<6f", message.image.data))
    # Pixels that are unreliable, occluded or beyond the range (23 and -2) are below the minimum.
    valid = disparity_px >= message.min_disparity
    assert valid.tolist() == [True, False, False, False, False, True]
    assert (message.f * message.t / disparity_px[valid]).tolist() == [5, 5]
    assert message.valid_window == RegionOfInterest(0, 0, 2, 3, False)


def test_the_cloud_has_a_point_of_16_bytes_for_each_pixel(conversions):
    message = PointCloud2()
    rgb = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    conversions.fill_cloud(message, PointField, HEADER, rgb, np.array(DEPTH_M, np.float32), CAMERA)
    assert message.fields == [
        PointField(name, offset, 7, 1) for name, offset in (("x", 0), ("y", 4), ("z", 8), ("rgb", 12))
    ]
    assert (message.height, message.width, message.point_step, message.row_step) == (2, 3, 16, 48)
    assert (message.is_bigendian, message.is_dense, len(message.data)) == (False, False, 96)
    points = list(struct.iter_unpack("<fffI", message.data))
    # Column 0 of row 0 is 5 m away: x = (0 - 1) / 100 * 5, y = 0; its colour is 0, 1, 2.
    assert points[0] == pytest.approx((-0.05, 0, 5, 0x000102))
    # Column 2 of row 1: x = (2 - 1) / 100 * 5, y = 1 / 100 * 5; its colour is 15, 16, 17.
    assert points[5] == pytest.approx((0.05, 0.05, 5, 0x0F1011))
    for unknown in (1, 3, 4):
        assert np.isnan(points[unknown][:3]).all()


def test_the_node_is_python_and_fills_messages_by_these_functions(conversions):
    text = (EXAMPLES / "ros2" / "stereoweave_node.py").read_text(encoding="utf-8")
    compile(text, "stereoweave_node.py", "exec")
    (imported,) = re.findall(r"from conversions import (.*)", text)
    assert all(callable(getattr(conversions, name)) for name in imported.split(", "))
