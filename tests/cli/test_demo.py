"""The command demo: a first result without any pictures of one's own."""

from pathlib import Path

import numpy as np
import pytest
from command_output import without_steps
from PIL import Image

from stereoweave.cli.root import main
from stereoweave.io.images import read_image
from stereoweave.io.maps import read_pfm
from stereoweave.outputs.results import ALWAYS
from stereoweave.pictures.sample import sample_folder


@pytest.fixture(autouse=True)
def sample(tmp_path_factory, monkeypatch) -> Path:
    """Let the command find the sample at half its size; `make demo` in test_readme.py takes the whole."""
    folder = tmp_path_factory.mktemp("sample")
    for eye in ("left.jpg", "right.jpg"):
        with Image.open(sample_folder() / eye) as picture:
            picture.resize((320, 240), Image.Resampling.BOX).save(folder / eye, quality=95)
    (folder / "calib.txt").write_text(
        "cam0=[240 0 159.5; 0 240 119.5; 0 0 1]\ndoffs=0\nbaseline=406\nwidth=320\nheight=240\n"
    )
    monkeypatch.setattr("stereoweave.pictures.sample.sample_folder", lambda: folder)
    return folder


@pytest.fixture(autouse=True)
def empty_folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_demo_writes_depth_a_report_and_a_view_and_says_what_to_open(sample, empty_folder, capfd):
    assert main(["demo"]) == 0
    assert [path.name for path in empty_folder.iterdir()] == ["demo"]
    names = {path.name for path in Path("demo").iterdir()}
    assert names == {*ALWAYS, "depth.png", "view.png"}
    printed, told = capfd.readouterr()
    assert without_steps(told) == []
    assert printed.splitlines()[-1] == f"open in a browser: {empty_folder / 'demo' / 'report.html'}"
    # The view from halfway between the cameras is neither of their pictures.
    view = read_image("demo/view.png").astype(int)
    for eye in ("left.jpg", "right.jpg"):
        assert np.abs(view - read_image(sample / eye)).mean() > 5


def test_the_demo_gives_what_depth_gives_for_the_sample(sample):
    assert main(["demo", "-o", "new/one"]) == 0
    pictures = [str(sample / name) for name in ("left.jpg", "right.jpg", "calib.txt")]
    assert main(["depth", *pictures[:2], "--calib", pictures[2], "-o", "other"]) == 0
    np.testing.assert_array_equal(read_pfm("new/one/disparity.pfm"), read_pfm("other/disparity.pfm"))
