import csv
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stereoweave.bench.classical.matchers import CLASSICAL_MATCHERS, make_classical_matcher
from stereoweave.bench.opencv_matchers import OPENCV_MATCHERS
from stereoweave.cli.root import main
from stereoweave.errors import StereoweaveError
from stereoweave.stereo import StereoPair


@pytest.fixture
def dots(rng):
    """Return a pair of random dots at 7 px."""
    image = rng.integers(0, 256, (48, 107, 3), dtype=np.uint8)
    return StereoPair(left=image[:, :100].copy(), right=image[:, 7:].copy())


@pytest.mark.parametrize("name", CLASSICAL_MATCHERS)
def test_each_finds_the_disparity_of_random_dots(dots, name):
    disparity_px = make_classical_matcher(name)(dots)
    assert disparity_px.shape == (48, 100)
    assert disparity_px.dtype == np.float32
    np.testing.assert_allclose(disparity_px[4:-4, 14:-4], 7, atol=0.25)


@pytest.mark.parametrize("name", CLASSICAL_MATCHERS)
def test_a_surface_at_0_px_is_found_and_no_hole(dots, name):
    disparity_px = make_classical_matcher(name)(StereoPair(left=dots.left, right=dots.left))
    known_px = disparity_px[4:-4, 4:-4]
    assert (known_px > 0).mean() > 0.99
    assert np.median(known_px) == pytest.approx(0, abs=0.01)


@pytest.mark.parametrize("name", CLASSICAL_MATCHERS)
@pytest.mark.parametrize("size", [(1, 9), (9, 1), (1, 1)])
def test_each_matches_a_pair_of_one_row_or_column(name, size):
    image = np.full((*size, 3), 90, np.uint8)
    disparity_px = make_classical_matcher(name)(StereoPair(left=image, right=image))
    assert disparity_px.shape == size
    assert np.isfinite(disparity_px).all()


def test_an_unknown_matcher_is_named_with_those_that_are_known():
    expected = "expected one of adaptive_window, dynamic_programming, 3dmst, found 'words'"
    with pytest.raises(StereoweaveError, match=expected):
        make_classical_matcher("words")


@pytest.fixture
def scenes(dots, tmp_path):
    scene = tmp_path / "scenes" / "dots"
    scene.mkdir(parents=True)
    Image.fromarray(dots.left).save(scene / "left.png")
    Image.fromarray(dots.right).save(scene / "right.png")
    Image.fromarray(np.full((48, 100), 7 * 256, np.uint16)).save(scene / "disparity.png")
    return scene.parent


def test_bench_pairs_scores_a_named_matcher_beside_opencv_s(scenes, tmp_path, capfd):
    rows = tmp_path / "rows.csv"
    options = f"--matchers dynamic_programming -o {rows} --sparsification {tmp_path}/curves.png"
    assert main(["bench", "pairs", str(scenes), *options.split()]) == 0
    with rows.open() as file:
        found = {row["matcher"]: row for row in csv.DictReader(file) if row["scene"] == "mean"}
    assert list(found) == [*OPENCV_MATCHERS, "dynamic_programming"]
    assert float(found["dynamic_programming"]["bad2_percent"]) < 10
    assert "dynamic_programming" in capfd.readouterr().out


@pytest.mark.parametrize(
    ("options", "scored"),
    [
        ("--matchers 3dmst --matchers adaptive_window", ["3dmst", "adaptive_window"]),
        ("--matchers 3dmst --model small", ["3dmst", "small", "small refined"]),
        ("--model small", ["small", "small refined"]),
    ],
)
def test_networks_are_scored_beside_named_matchers_only_if_they_are_named(
    scenes, monkeypatch, options, scored
):
    makers = []

    def stop(given, *_):
        makers.extend(given)
        raise StereoweaveError("enough")

    monkeypatch.setattr("stereoweave.bench.pairs.score_pairs", stop)
    assert main(f"bench pairs {scenes} {options} -o {scenes}/rows.csv".split()) == 2
    assert makers == scored


def test_an_unknown_matcher_is_reported_in_one_line_before_anything_is_measured(scenes, capfd, monkeypatch):
    monkeypatch.chdir(scenes)
    assert main(f"bench pairs {scenes} --matchers words".split()) == 2
    printed, told = capfd.readouterr()
    assert printed == ""
    assert told.strip().splitlines() == [
        "stereoweave: --matchers: expected one of adaptive_window, dynamic_programming, 3dmst, found 'words'"
    ]
    assert not Path("pairs.csv").exists()
