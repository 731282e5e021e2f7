"""The option --screen of `stereoweave view`."""

import numpy as np
import pytest
from PIL import Image

from stereoweave.cli.root import main
from stereoweave.io.images import read_image
from stereoweave.matching.matcher import Matcher
from stereoweave.rendering.comfort import SCREENS


@pytest.fixture
def flat(rng, tmp_path, monkeypatch) -> None:
    """Write a pair of a wall of 200x64 px at a disparity of 8 px, 4 % of the width, to the current folder."""
    monkeypatch.chdir(tmp_path)
    photograph = Image.fromarray(rng.integers(0, 256, (8, 26, 3), dtype=np.uint8)).resize((208, 64))
    photograph.crop((0, 0, 200, 64)).save("left.png")
    photograph.crop((8, 0, 208, 64)).save("right.png")


def view(words: str) -> int:
    return main(["view", "left.png", "right.png", "--model=small", "--threads=1", *words.split()])


def test_a_wall_is_put_on_the_screen(flat, capsys):
    assert view("--layout side_by_side --screen television -o v.png") == 0
    line = capsys.readouterr().out.splitlines()[1]
    assert line.startswith("television: strength 1.00, convergence 8.")
    # Both eyes' views show the wall in the same columns.
    left, right = np.split(read_image("v_LRF_Full_SBS.png").astype(int), 2, axis=1)
    assert np.abs(left - right)[:, 16:-16].mean() < 6


def test_a_given_convergence_wins_and_is_named(flat, capsys):
    # At 0 px, the wall is 8 px in front; 1 % of 200 px is 2 px, a quarter of that.
    assert view("--layout side_by_side --screen television --convergence 0 -o v.png") == 0
    first, line, *_ = capsys.readouterr().out.splitlines()
    assert line.startswith("television: strength 0.2")
    assert line.endswith("convergence as given")
    # The wall is 2 px in front of both borders.
    assert first.endswith("400x64 px, floating window 2 px left and 2 px right")
    left, right = np.split(read_image("v_LRF_Full_SBS.png"), 2, axis=1)
    assert left[:, 0].max() == right[:, -1].max() == 0
    assert min(left[:, -1].max(), right[:, 0].max()) > 0


@pytest.mark.parametrize(
    ("words", "fragments"),
    [
        (
            "-o v.png",
            [
                "--screen: expected only with a layout of several views, found with a single view; ",
                "choose one, such as side_by_side or anaglyph_dubois (--layout)",
            ],
        ),
        ("--layout wiggle -o v.gif", ["--screen", "found with wiggle"]),
        ("--layout viewer -o v.html", ["--screen", "found with viewer"]),
        ("--layout rgbd -o v.png", ["--screen", "found with rgbd"]),
    ],
)
def test_a_screen_needs_a_layout_of_several_views(flat, monkeypatch, capsys, words, fragments):
    monkeypatch.setattr(Matcher, "estimate_many", None)
    assert view(f"--screen phone {words}") == 2
    line = capsys.readouterr().err
    assert all(fragment in line for fragment in fragments)
    assert line.count("\n") == 1


@pytest.mark.parametrize("command", ["view", "video", "check"])
def test_the_help_names_all_screens(command, capsys):
    assert main([command, "--help"]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert all(screen in words for screen in SCREENS)


@pytest.mark.parametrize("screen", ["tv", "Phone", "-1"])
def test_an_unknown_screen_is_named(flat, capsys, screen):
    assert view(f"--layout quilt --screen={screen} -o v.png") == 2
    expected = f"--screen: expected one of phone, television, headset, light_field, found {screen!r}"
    assert expected in capsys.readouterr().err
