"""Conversion of videos whose frames are rectified by a calibration."""

from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from conversions import frames_of, interrupt, run, write_slow_video
from rig_examples import Cameras, Sphere, fisheye, pinhole, rig_of, speckle
from spatial_examples import SPATIAL
from video_examples import example_pairs, write_side_by_side, write_video

from stereoweave.cameras.calibration_files import write_rig
from stereoweave.cameras.content import crop
from stereoweave.cameras.rectify import rectify
from stereoweave.cameras.rig import make_rectified_rig
from stereoweave.errors import StereoweaveError
from stereoweave.stereo import StereoPair
from stereoweave.video.reader import open_video

pytestmark = pytest.mark.usefixtures("default_interrupts")

WALL_M = 5.0
RIG = rig_of(pinhole)


@pytest.fixture(scope="module")
def wall(tmp_path_factory) -> Path:
    """Return a video by a crooked rig of a wall that is 5 m away in every direction."""
    texture = speckle(np.random.default_rng(0))
    pair = Cameras(RIG).photograph([Sphere(WALL_M)], texture, texel_m=0.009)
    path = tmp_path_factory.mktemp("wall") / "wall.mkv"
    return write_side_by_side(path, [(pair.left, pair.right)] * 2, codec="libx264")


@pytest.fixture(scope="module")
def calibration(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("calibration") / "rig.yml"
    write_rig(path, RIG)
    return path


def write_parallel_calibration(path: Path, doffs_px: float, baseline_mm: float = 100) -> Path:
    """Write the calibration of rectified pictures of 160x96 px, with a focal length of 300 px."""
    cameras = [f"cam{i}=[300 0 {79.5 + i * doffs_px}; 0 300 47.5; 0 0 1]" for i in (0, 1)]
    numbers = [f"doffs={doffs_px}", f"baseline={baseline_mm}", "width=160", "height=96"]
    path.write_text("\n".join([*cameras, *numbers]))
    return path


def comment_of(video: Path) -> str:
    with av.open(str(video)) as container:
        return container.metadata["COMMENT"]


def test_frames_are_those_of_rectified_pictures_without_the_borders(wall):
    video = open_video([wall], "side_by_side")
    rectified = video.rectify(RIG)
    given, found = next(video.frames()), next(rectified.frames())
    expected = crop(rectify(StereoPair(left=given.left, right=given.right), RIG).pair)
    width, height = rectified.size_px
    assert (width % 2, height % 2) == (0, 0)
    assert 0 <= expected.left.shape[1] - width <= 1
    assert 0 <= expected.left.shape[0] - height <= 1
    np.testing.assert_array_equal(found.left, expected.left[:height, :width])
    np.testing.assert_array_equal(found.right, expected.right[:height, :width])
    assert rectified.camera == expected.camera


def test_depth_of_a_wall_at_5_m_is_true(wall, calibration, tmp_path, capsys):
    out = tmp_path / "depth.mkv"
    assert run(wall, out, "--depth16", "--format", "side_by_side", "--calib", str(calibration)) == 0
    assert f"rectified with {calibration}: left picture rotated by" in capsys.readouterr().err
    constant = float(comment_of(out).removesuffix(" / value").rpartition(" = ")[2])
    camera = open_video([wall], "side_by_side").rectify(RIG).camera
    for frame in frames_of(out):
        rows, columns = np.indices(frame.shape)
        ideal = (columns - camera.cx_px) / camera.focal_px, (rows - camera.cy_px) / camera.focal_px
        expected_m = WALL_M / np.sqrt(1 + ideal[0] ** 2 + ideal[1] ** 2)
        off_m = np.abs(constant / frame - expected_m)[20:-20, 40:-20]
        assert np.median(off_m) < 0.03 * WALL_M


@pytest.mark.parametrize(
    ("doffs_px", "divisor"), [(0, "value"), (12, "(value + 3072)"), (-2.5, "(value - 640)")]
)
def test_a_calibration_of_rectified_pictures_adds_metres_alone(tmp_path, doffs_px, divisor):
    video = write_side_by_side(tmp_path / "in.mp4", example_pairs(2), codec="libx264")
    calibration = write_parallel_calibration(tmp_path / "calib.txt", doffs_px)
    for name, words in (("plain", []), ("metric", ["--calib", str(calibration)])):
        assert run(video, tmp_path / f"{name}.mkv", "--depth16", *words) == 0
    plain, metric = (frames_of(tmp_path / f"{name}.mkv") for name in ("plain", "metric"))
    np.testing.assert_array_equal(metric, plain)
    # 300 px * 0.1 m * 256.
    assert comment_of(tmp_path / "metric.mkv").endswith(f"; depth in metres = 7680 / {divisor}")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "rig.yml: expected a calibration for pictures of 160x96, found one for 640x480"),
        (
            ["--no-rectify"],
            "rig.yml: expected a calibration of rectified frames, found lenses with distortion; "
            "rectify the frames with it (--rectify)",
        ),
        (
            ["--projection", "fisheye"],
            "in.mp4: expected no calibration for a VR180 or 360-degree video, found {calibration}; "
            "omit it, or choose rectilinear if the video is an ordinary one (--calib, --projection)",
        ),
    ],
)
def test_a_calibration_that_does_not_fit_is_refused_in_one_line(tmp_path, capsys, calibration, words, told):
    video = write_side_by_side(tmp_path / "in.mp4", example_pairs(2), codec="libx264")
    words = ["--depth", "--calib", str(calibration), *words]
    assert run(video, tmp_path / "out.mp4", *words) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert told.format(calibration=calibration) in line
    assert [path.name for path in tmp_path.iterdir()] == ["in.mp4"]


def test_cameras_that_hardly_see_the_same_are_refused(wall):
    rig = rig_of(pinhole, degrees=(48, 0, 0))
    with pytest.raises(StereoweaveError, match=r"^the calibration: expected at least 32x32 pixels that both"):
        open_video([wall], "side_by_side").rectify(rig)


def test_an_excerpt_of_two_files_by_fisheye_lenses_has_the_frames_of_the_rectified_video(tmp_path):
    rig = replace(rig_of(fisheye), size_px=None)
    pairs = [tuple(np.tile(view, (5, 4, 1)) for view in pair) for pair in example_pairs(4)]
    files = [tmp_path / f"{side}.mkv" for side in ("left", "right")]
    for file, views in zip(files, zip(*pairs, strict=True), strict=True):
        write_video(file, views, codec="libx264")
    video = open_video(files).rectify(rig)
    part = video.excerpt(0.08, 0.08)  # of 25 frames a second
    expected = list(video.frames())[2:]
    assert part.size_px == video.size_px == (expected[0].left.shape[1], expected[0].left.shape[0])
    for found, frame in zip(part.frames(), expected, strict=True):
        np.testing.assert_array_equal(found.left, frame.left)
        np.testing.assert_array_equal(found.right, frame.right)


def test_pictures_with_all_their_bits_are_rectified_like_those_of_8_bits(wall):
    video = open_video([wall], "side_by_side").rectify(RIG)
    video.read_fine()
    frame = next(video.frames())
    for fine, view in zip(frame.fine(), (frame.left, frame.right), strict=True):
        off = np.abs(np.clip(fine, 0, 255) - view)
        assert fine.dtype == np.float32
        assert off.mean() < 1


def test_the_camera_of_a_spatial_video_is_replaced_with_a_note():
    video = open_video([SPATIAL])
    rig = make_rectified_rig(*[np.array([[300.0, 0, 159.5], [0, 300, 119.5], [0, 0, 1]])] * 2, -0.1)
    calibrated = video.rectify(rig)
    assert video.camera.baseline_m != 0.1
    assert calibrated.camera.baseline_m == 0.1
    assert "the calibration replaces the camera that the video declares" in map(str, calibrated.notes)


def test_disparities_beyond_infinity_are_noted(tmp_path, capsys):
    """The right views are moved by 40 px, as by converged cameras whose doffs the calibration lacks."""
    pairs = [(left, np.roll(right, 40, axis=1)) for left, right in example_pairs(2)]
    video = write_side_by_side(tmp_path / "in.mp4", pairs, codec="libx264")
    words = ["--calib", str(write_parallel_calibration(tmp_path / "calib.txt", 0))]
    assert run(video, tmp_path / "out.mp4", "--depth", "--format", "side_by_side", *words) == 0
    told = capsys.readouterr().err
    assert "depths in metres are wrong: " in told
    assert told.count("give a calibration with doffs (--calib)") == 1


@pytest.mark.parametrize("doffs_px", [0, 12])
def test_the_output_is_marked_with_a_camera_without_doffs_alone(tmp_path, doffs_px):
    video = write_side_by_side(tmp_path / "in.mp4", example_pairs(2), codec="libx264")
    calibration = write_parallel_calibration(tmp_path / "calib.txt", doffs_px)
    words = ["--layout", "side_by_side", "--calib", str(calibration)]
    assert run(video, tmp_path / "out.mp4", *words) == 0
    [out] = tmp_path.glob("out*.mp4")
    assert (open_video([out]).camera is None) == bool(doffs_px)


def test_a_conversion_with_another_calibration_is_not_resumed(tmp_path, monkeypatch, capsys):
    video = write_slow_video(tmp_path / "in.mp4", example_pairs(10))
    words = ["--depth", "--calib", str(tmp_path / "calib.txt")]
    write_parallel_calibration(tmp_path / "calib.txt", 0)
    with monkeypatch.context() as patch:
        interrupt(patch)
        assert run(video, tmp_path / "out.mp4", *words) == 130
    write_parallel_calibration(tmp_path / "calib.txt", 0, baseline_mm=120)
    capsys.readouterr()
    assert run(video, tmp_path / "out.mp4", *words) == 2
    assert "found parts made with another --calib;" in capsys.readouterr().err
