"""The command `stereoweave view` with layouts: its files, messages and errors."""

import json
import re
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from stereoweave.cli.root import main
from stereoweave.io.images import read_image
from stereoweave.matching.matcher import Matcher
from stereoweave.rendering.layouts import ANIMATIONS, LAYOUTS, VIEWER, LayoutOptions, median_disparity_px
from stereoweave.rendering.renderer import Renderer
from stereoweave.stereo import StereoPair


def run(line: str) -> int:
    return main(line.split())


@pytest.fixture
def pair(rng, tmp_path, monkeypatch) -> StereoPair:
    """Write a pair of 95x64 with a disparity of 8 px to the current folder."""
    monkeypatch.chdir(tmp_path)
    photograph = Image.fromarray(rng.integers(0, 256, (8, 13, 3), dtype=np.uint8)).resize((104, 64))
    left, right = photograph.crop((0, 0, 95, 64)), photograph.crop((8, 0, 103, 64))
    left.save("left.png")
    right.save("right.png")
    return StereoPair(left=np.asarray(left).copy(), right=np.asarray(right).copy())


def written(before: set[Path]) -> Path:
    (file,) = set(Path().iterdir()) - before
    return file


def test_a_quilt_of_48_views_matches_once(pair, monkeypatch, capfd):
    sizes = []
    estimate_many = Matcher.estimate_many

    def counted(matcher, pairs, **options):
        sizes.extend(pair.left.shape[:2] for pair in pairs)
        return estimate_many(matcher, pairs, **options)

    monkeypatch.setattr(Matcher, "estimate_many", counted)
    assert run("view left.png right.png --layout quilt --model base --threads 1 -o view.png") == 0
    # The notes take two more matches, at half the size.
    assert sizes.count((64, 95)) == 1
    assert set(sizes[1:]) <= {(32, 47)}
    assert read_image("view_qs8x6a1.484.png").shape == (6 * 64, 8 * 95, 3)
    printed = capfd.readouterr().out.splitlines()
    assert printed[0] == "view_qs8x6a1.484.png: quilt, 760x384 px"


@pytest.mark.parametrize(
    ("arguments", "file", "layout", "strength", "convergence_px"),
    [
        ("--layout side_by_side -o v.png", "v_LRF_Full_SBS.png", "side_by_side", 1.0, 0.0),
        ("--layout top_bottom_half --strength 0.5 -o v.png", "v_half_TB.png", "top_bottom_half", 0.5, 0.0),
        ("--layout anaglyph_dubois -o v.png", "v.png", "anaglyph_dubois", 1.0, None),
        ("--layout quilt --quilt 3x2 -o v.png", "v_qs3x2a1.484.png", "quilt", 1.0, None),
        ("--layout contact_sheet --convergence 3.5 -o v.png", "v.png", "contact_sheet", 1.0, 3.5),
        ("--layout rgbd -o v.png", "v_RGBD.png", "rgbd", 1.0, 0.0),
    ],
)
def test_a_layout_is_rendered_from_one_estimate_with_strength_and_convergence(
    pair, arguments, file, layout, strength, convergence_px
):
    before = set(Path().iterdir())
    assert run(f"view left.png right.png --model small --threads 1 {arguments}") == 0
    assert written(before) == Path(file)
    estimate = Matcher("small", threads=1).estimate(pair.left, pair.right, refined=True)
    plane_px = median_disparity_px(estimate) if convergence_px is None else convergence_px
    renderer = Renderer(pair, estimate, strength=strength, convergence_px=plane_px, threads=1)
    choices = LayoutOptions(columns=3, rows=2) if "3x2" in arguments else LayoutOptions()
    expected = LAYOUTS[layout].compose(renderer, choices)
    np.testing.assert_array_equal(np.asarray(Image.open(file)), expected)


def test_the_median_disparity_of_a_wall_is_its_own(pair):
    estimate = Matcher("small", threads=1).estimate(pair.left, pair.right)
    assert median_disparity_px(estimate) == pytest.approx(8, abs=0.5)


def test_a_single_view_uses_strength_and_reports_the_share_that_neither_camera_saw(pair, capfd):
    arguments = "view left.png right.png --model small --threads 1"
    assert run(f"{arguments} --position 1.5 --strength 0.5 -o narrow.png") == 0
    assert run(f"{arguments} --position 1 -o right_again.png") == 0
    np.testing.assert_array_equal(read_image("narrow.png"), pair.right)  # 0.5 + 0.5 * (1.5 - 0.5) = 1
    np.testing.assert_array_equal(read_image("right_again.png"), pair.right)
    assert "narrow.png: view at 1.5, 0.0 % of it holes or borders" in capfd.readouterr().out


def test_the_extension_of_a_file_can_select_the_layout(pair, capfd):
    assert run("view left.png right.png --model small -o v.mpo") == 0
    assert "v.mpo: two pictures of 95x64 px in one file" in capfd.readouterr().out
    assert run("view left.png right.png --model small -o v.jps") == 0
    with Image.open("v.mpo") as file:
        assert (file.n_frames, file.size) == (2, (95, 64))
        assert np.abs(np.asarray(file).astype(int) - pair.left).mean() < 3
    with Image.open("v.jps", formats=["JPEG"]) as file:
        assert np.abs(np.asarray(file)[:, :95].astype(int) - pair.right).mean() < 3


def test_a_wiggle_of_equal_pictures_is_not_called_moving(pair, capfd):
    words = "--layout wiggle --convergence 0 --model small --threads 1 --no-rectify"
    assert run(f"view left.png left.png {words} -o v.webp") == 0
    with Image.open("v.webp") as file:
        assert file.n_frames == 1
    assert capfd.readouterr().out.startswith("v.webp: wiggle, a still picture, because nothing moves in it\n")


@pytest.mark.parametrize("ending", [".gif", ".webp", ".mp4"])
def test_a_wiggle_moves(pair, capfd, ending):
    # At convergence 0, because at the wall's own disparity, the wall would stay in place in all frames.
    wiggle = "--layout wiggle --convergence 0 --model small --threads 1"
    assert run(f"view left.png right.png {wiggle} -o v{ending}") == 0
    count = len(ANIMATIONS["wiggle"].positions)
    if ending == ".mp4":
        with av.open("v.mp4") as film:
            assert len(list(film.decode(video=0))) == 5 * count
        said = "v.mp4: wiggle, 60 frames in 3.6 s"
    else:
        with Image.open(f"v{ending}") as file:
            assert (file.n_frames, file.size) == (count, (95, 64))
        said = f"v{ending}: wiggle, 12 frames in 0.72 s"
    assert capfd.readouterr().out.startswith(said)


def test_the_viewer_is_a_page_named_after_the_pictures(pair, capfd):
    assert run("view left.png right.png --model small --threads 1 -o photo.html") == 0
    assert capfd.readouterr().out.startswith("photo.html: viewer, 0.")
    page = Path("photo.html").read_text(encoding="utf-8")
    assert "<title>left.png + right.png</title>" in page
    scene = json.loads(re.search(r'id="scene">(.*?)</script>', page)[1])
    assert scene["size_px"] == [95, 64]
    assert scene["plane_px"] == pytest.approx(8, abs=0.5)  # the wall stays in place


@pytest.mark.parametrize(("size", "size_px"), [("48", (48, 32)), ("900x16", None), ("900x32", (48, 32))])
def test_views_are_scaled_down_to_a_size(pair, size, size_px):
    code = run(f"view left.png right.png --model small --threads 1 --size {size} -o v.png")
    if size_px is None:
        assert code == 2
        return
    with Image.open("v.png") as file:
        assert file.size == size_px
    assert run(f"view left.png right.png --model small --layout wiggle --size {size} -o v.webp") == 0
    with Image.open("v.webp") as file:
        assert file.size == size_px


@pytest.mark.parametrize(
    ("arguments", "width_px"),
    [
        ("--position 1.5 -o v.png", 91),  # half a baseline at a disparity of 8: 4 px that no camera saw
        ("--layout anaglyph_grey --convergence 20 -o v.png", 91),  # 2 px at each border; test_cropping.py
        ("--layout wiggle --convergence 20 -o v.gif", 91),
    ],
)
def test_cropping_leaves_what_all_views_show(pair, arguments, width_px):
    assert run(f"view left.png right.png --model small --threads 1 --crop auto {arguments}") == 0
    with Image.open(arguments.split()[-1]) as file:
        assert file.height == 64
        assert file.width == pytest.approx(width_px, abs=2)  # the disparity is estimated


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        ("--layout viewer -o v.png", ["v.png", ".html", "viewer", "found .png"]),
        ("--layout quilt -o v.html", ["v.html", "viewer", "found quilt"]),
        ("--layout viewer --strength 4 -o v.html", ["position", "-1 to 2", "-1.9", "strength 4"]),
        ("--layout viewer --position 0.3 -o v.html", ["--position", "single view", "viewer"]),
        ("--layout quilt --crop auto -o v.png", ["--crop", "an anaglyph", "found with quilt"]),
        ("--crop 5 -o v.png", ["--crop", "expected auto", "'5'"]),
        ("--size big -o v.png", ["--size", "1600x1200", "'big'"]),
        ("--size 31 -o v.png", ["--size", "at least 32 px", "'31'"]),
        ("--layout holo -o v.png", ["layout", *LAYOUTS, *ANIMATIONS, "found 'holo'"]),
        ("--layout wiggle -o v.png", ["v.png", ".mp4, .gif, .webp", "found .png"]),
        ("--layout quilt -o v.mp4", ["v.mp4", ".png", "found .mp4"]),
        ("--layout quilt -o v.jps", ["v.jps", "crossed", "found quilt"]),
        ("--layout side_by_side --strength 4 -o v.png", ["--strength", "-1 to 2", "-1.5", "strength 4"]),
        (
            "--layout quilt --strength 2 -o v.png",
            ["--strength", "-1 to 2", "-1.5", "-0.5 at strength 2"],
        ),
        ("--layout sweep --strength 3.5 -o v.gif", ["--strength", "-1 to 2", "strength 3.5"]),
        ("--position 2 --strength 1.5 -o v.png", ["--strength", "-1 to 2", "2.75"]),
        ("--strength nan -o v.png", ["--strength", "expected at least 0"]),
        ("--strength -1 -o v.png", ["--strength"]),
        ("--layout quilt --position 0.3 -o v.png", ["--position", "single view", "quilt", "--strength"]),
        ("--quilt 5x9 -o v.png", ["--quilt", "--layout quilt", "a single view"]),
        ("--layout rgbd --quilt 5x9 -o v.png", ["--quilt", "--layout quilt", "rgbd"]),
        ("--layout quilt --quilt 48 -o v.png", ["--quilt", "8x6", "'48'"]),
        ("--layout quilt --quilt 900x900 -o v.png", ["quilt", "2 to 200 views", "900x900"]),
        ("--convergence middle -o v.png", ["--convergence", "px, or auto", "'middle'"]),
        ("--convergence inf -o v.png", ["--convergence", "px, or auto", "'inf'"]),
        ("--size 80 --convergence 999 -o v.png", ["--convergence", "(the picture's width), got 999"]),
        ("--layout rgbd -o taken.png", ["taken_RGBD.png", "expected a writable file", "found a folder"]),
    ],
)
def test_a_mistake_is_reported_in_one_line_before_anything_is_matched(
    pair, monkeypatch, capfd, arguments, fragments
):
    def unmatched(*_, **__):
        raise AssertionError("matched")

    monkeypatch.setattr(Matcher, "estimate_many", unmatched)
    Path("taken_RGBD.png").mkdir()
    before = sorted(Path().rglob("*"))
    assert run(f"view left.png right.png {arguments}") == 2
    printed, told = capfd.readouterr()
    assert printed == ""
    (line,) = told.splitlines()
    assert line.startswith("stereoweave: ")
    assert [fragment for fragment in fragments if fragment not in line] == []
    assert sorted(Path().rglob("*")) == before


def test_the_help_names_every_layout_and_animation(capfd):
    assert run("view --help") == 0
    words = set(re.findall(r"\w+", capfd.readouterr().out))
    assert {*LAYOUTS, *ANIMATIONS, VIEWER} <= words
