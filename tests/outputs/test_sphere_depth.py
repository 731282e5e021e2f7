import json

import cv2
import numpy as np
import pytest
from PIL import Image

from experiments.sphere_windows.room import cast, look_equirectangular, render_fixed, render_turning
from stereoweave.cameras.spherical import Projection, SphereRequest
from stereoweave.cli.root import main
from stereoweave.pictures.loading import open_pictures

HALF = Projection.named("half_equirectangular")


def run(*words):
    return main([*map(str, words)])


def save(path, left, right):
    Image.fromarray(np.hstack([left, right])).save(path)
    return path


def measure_error_percent(found, scene, rays, axis, least_deg, most_deg):
    """Return the median error between two angles from the plane across the given axis."""
    aside_deg = np.degrees(np.abs(np.arcsin(rays[..., axis])))
    chosen = (aside_deg >= least_deg) & (aside_deg < most_deg)
    return float(np.median(100 * np.abs(found[chosen] / scene.distance[chosen] - 1)))


def test_distances_of_a_room_are_right_where_the_baseline_is_seen(tmp_path):
    rays = look_equirectangular((384, 384))
    scene = render_fixed(rays)
    path = save(tmp_path / "a_180.png", scene.left, scene.right)
    words = "--whole", "--format", "side_by_side", "--model", "small", "--baseline-m", "0.063"
    assert run("depth", path, *words, "-o", tmp_path / "out") == 0
    found = np.load(tmp_path / "out" / "distance.npy") / 0.063
    assert measure_error_percent(found, scene, rays, 0, 0, 30) < 1.5
    assert measure_error_percent(found, scene, rays, 0, 30, 45) < 2
    assert measure_error_percent(found, scene, rays, 0, 45, 60) < 6
    # The left and right poles, where the eyes are in line, are said to be unknown.
    aside_deg = np.degrees(np.abs(np.arcsin(rays[..., 0])))
    np.testing.assert_array_equal(np.isnan(found), aside_deg > 75)
    facts = json.loads((tmp_path / "out" / "distance.json").read_text())
    assert facts["unit"] == "m" and facts["projection"] == "half_equirectangular"
    # 25 baselines below and 30 ahead; a corner of the room is 50 away.
    assert 22 * 0.063 < facts["distance_p1"] < 27 * 0.063
    with Image.open(tmp_path / "out" / "distance.pfm") as stored:
        values = np.asarray(stored)
    assert np.isinf(values[aside_deg > 75]).all()


def test_distances_all_around_are_right_and_have_no_seam(tmp_path, capsys):
    scene = render_turning((768, 384))
    rays = look_equirectangular((768, 384), 360.0)
    path = save(tmp_path / "a_360.png", scene.left, scene.right)
    words = "--whole", "--format", "side_by_side", "--model", "small"
    assert run("depth", path, *words, "-o", tmp_path / "out") == 0
    assert "beyond 75 degrees above and below, distances are unknown" in capsys.readouterr().out
    found = np.load(tmp_path / "out" / "distance.npy")
    assert measure_error_percent(found, scene, rays, 1, 0, 30) < 2
    assert measure_error_percent(found, scene, rays, 1, 30, 60) < 2
    steps = np.abs(1 / np.roll(found, 1, axis=1) - 1 / found)[100:284]
    # Column 0 follows the last one, behind the camera.
    assert np.median(steps[:, 0]) < 3 * np.median(steps)


def test_views_of_the_whole_are_vr180_again(tmp_path):
    # The whole of position 0 is the left eye's picture; halfway, near walls move by half their disparity.
    rays = look_equirectangular((256, 256))
    scene = render_fixed(rays)
    left, right = (cv2.GaussianBlur(eye, (0, 0), 2) for eye in (scene.left, scene.right))
    path = save(tmp_path / "a_180.png", left, right)
    words = path, "--whole", "--format", "side_by_side", "--model", "small"
    assert run("view", *words, "--layout", "side_by_side", "-o", tmp_path / "sbs.png") == 0
    [both] = tmp_path.glob("sbs*.png")
    with Image.open(both) as picture:
        error = np.abs(np.asarray(picture).astype(int) - np.hstack([left, right]))
    assert error.mean() < 1
    assert run("view", *words, "--position", "0.5", "-o", tmp_path / "middle.png") == 0
    expected = cv2.GaussianBlur(cast(rays, np.array([0.0, 0, 0]))[0], (0, 0), 2)
    with Image.open(tmp_path / "middle.png") as picture:
        middle = np.asarray(picture).astype(float)
    inner = np.s_[50:206, 50:206]
    error = np.abs(middle - expected)[inner].mean()
    assert error < 0.5 * np.abs(left.astype(float) - expected)[inner].mean()


def test_a_vr180_photo_is_written_and_opened_again(tmp_path):
    scene = render_fixed(look_equirectangular((256, 256)))
    left, right = (cv2.GaussianBlur(eye, (0, 0), 2) for eye in (scene.left, scene.right))
    path = save(tmp_path / "a_180.png", left, right)
    words = path, "--whole", "--format", "side_by_side", "--model", "small"
    out = tmp_path / "again.vr.jpg"
    assert run("view", *words, "--layout", "top_bottom", "-o", out) == 2
    assert not out.exists()
    assert run("view", *words, "--layout", "side_by_side", "-o", out) == 0
    opened = open_pictures([out], sphere=SphereRequest(whole=True))
    assert opened.projection is not None and opened.projection.yaw_deg == HALF.yaw_deg
    before = open_pictures([path], "side_by_side", SphereRequest(projection=HALF.name, whole=True))
    for name in ("left", "right"):
        eyes = [getattr(pictures.pair, name).astype(int) for pictures in (opened, before)]
        assert np.abs(eyes[0] - eyes[1]).mean() < 2


def test_a_window_is_no_vr180_photo(tmp_path, capsys):
    image = np.zeros((128, 256, 3), np.uint8)
    path, out = save(tmp_path / "a_180.png", image, image), tmp_path / "window.VR.jpg"
    assert run("view", path, "--format", "side_by_side", "--layout", "side_by_side", "-o", out) == 2
    assert capsys.readouterr().err == (
        f"stereoweave: {out}: expected the whole field of view for a VR180 photo, found a window; take the "
        "whole, or name the file otherwise (--whole)\n"
    )
    assert not out.exists()


@pytest.mark.parametrize("ending", [".mpo", ".heic", ".jps"])
def test_views_of_the_whole_are_written_as_3d_pictures(tmp_path, ending):
    scene = render_fixed(look_equirectangular((128, 128)))
    left, right = (cv2.GaussianBlur(eye, (0, 0), 2) for eye in (scene.left, scene.right))
    path = save(tmp_path / "a_180.png", left, right)
    words = path, "--whole", "--format", "side_by_side", "--model", "small"
    assert run("view", *words, "-o", tmp_path / f"b{ending}") == 0
    pair = open_pictures([tmp_path / f"b{ending}"]).pair
    for eye, expected in ((pair.left, left), (pair.right, right)):
        assert np.abs(eye.astype(int) - expected).mean() < 4


@pytest.mark.parametrize(
    ("command", "words", "said"),
    [
        ("depth", ["--whole"], "--whole: expected only for VR180 and 360-degree files"),
        ("depth", ["--whole", "--projection", "fisheye", "--write", "all"], "--write: expected no further"),
        ("view", ["--whole", "--layout", "quilt"], "expected one of side_by_side, crossed"),
        (
            "view",
            ["--whole", "--layout", "side_by_side", "--screen", "television"],
            "--screen: expected only for a window, found with the whole",
        ),
        ("view", ["--whole", "--up", "0.5"], "--up: expected only for a window, found with the whole"),
        ("view", ["--look", "30"], "--look: expected yaw and pitch in degrees, such as 30,-10, found '30'"),
        ("check", ["--projection", "equirectangular", "--look", "0,85"], "--look: expected a window"),
        ("rectify", ["--projection", "equirectangular", "--fov", "200"], "found 200"),
    ],
)
def test_a_wrong_setting_of_a_sphere_is_refused_in_one_line(tmp_path, capsys, command, words, said):
    image = np.random.default_rng(0).integers(0, 255, (128, 256, 3), dtype=np.uint8)
    path = save(tmp_path / "a.png", image, image)
    out = [] if command == "check" else ["-o", tmp_path / "out.png"]
    assert run(command, path, "--format", "side_by_side", *words, *out) != 0
    assert said in capsys.readouterr().err.strip().splitlines()[-1]


def test_rectify_writes_a_window_of_both_eyes(tmp_path):
    scene = render_turning((512, 256))
    path = save(tmp_path / "a_360.png", scene.left, scene.right)
    words = "--format", "side_by_side", "--look", "90,0", "--fov", "70"
    assert run("rectify", path, *words, "-o", tmp_path / "out") == 0
    with Image.open(tmp_path / "out" / "left.png") as left:
        # 256 px over 180 degrees are 81.5 px a radian; the window is 70 degrees wide.
        assert left.size[0] == 100
