import csv
import subprocess
import sys

import numpy as np
import pytest
from shard_examples import box_before_a_wall

from stereoweave.bench.error_classes import CLASSES
from stereoweave.cli.root import main
from stereoweave.data.packing import pack
from stereoweave.data.paper_layout import write_frame
from stereoweave.data.readers import read_scenes
from stereoweave.data.shards import write_shard
from stereoweave.errors import StereoweaveError
from stereoweave.io.images import write_image
from stereoweave.io.maps import write_pfm
from stereoweave.io.output_lock import lock_output
from stereoweave.learn.data import collage
from stereoweave.learn.data.sources import VALIDATION_SEED

NETWORKS = ["base", "small", "small refined"]  # base always refines
OPENCV = ["sgbm", "sgbm_8_paths", "sgbm_3_way", "bm"]
COLUMNS = (
    "matcher,scene,epe_px,bad1_percent,bad2_percent,d1_percent,edge_epe_px,edge_bad1_percent,flying_percent,"
    "ause_px,ause_bad1_percent,calibration_error,time_ms,time_relative,memory_mb,cpu,cores,opencv"
)


def pair(number):
    return box_before_a_wall(np.random.default_rng(number), (96, 64))


@pytest.fixture
def sets(tmp_path):
    """Write two rendered sets below one folder, with two pairs and with one."""
    write_shard(tmp_path / "sets" / "ship", "ship", 0, [pack(pair(0), {}), pack(pair(1), {})])
    write_shard(tmp_path / "sets" / "crane", "crane", 0, [pack(pair(2), {})])
    return tmp_path / "sets"


def test_all_pairs_of_rendered_sets_are_scenes(sets):
    scenes = list(read_scenes(sets))
    assert [scene.name for scene in scenes] == ["crane/crane-000000", "ship/ship-000000", "ship/ship-000001"]
    made = pair(1)
    np.testing.assert_array_equal(scenes[2].pair.left, made.left)
    np.testing.assert_array_equal(scenes[2].pair.right, made.right)
    np.testing.assert_allclose(scenes[2].truth_px, made.disparity_px, atol=0.001)
    assert scenes[2].pair.camera == made.camera


def test_the_frames_of_a_named_dataset_are_scenes(tmp_path):
    made = pair(3)
    write_frame(tmp_path, "0001", made)
    (scene,) = read_scenes(tmp_path, "paper")
    np.testing.assert_array_equal(scene.pair.right, made.right)
    with pytest.raises(StereoweaveError, match="expected one of sintel, .*, found 'words'"):
        read_scenes(tmp_path, "words")


def test_every_matcher_has_every_number_and_both_plots_are_written(sets, tmp_path, capfd, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    out = tmp_path / "out"
    options = f"-o {out}/rows.csv --plot {out}/time.png --sparsification {out}/curves.png --threads 1"
    assert main(f"bench pairs {sets / 'ship'} {options}".split()) == 0
    text = (out / "rows.csv").read_text()
    assert text.splitlines()[0] == COLUMNS
    means = {row["matcher"]: row for row in csv.DictReader(text.splitlines()) if row["scene"] == "mean"}
    assert list(means) == [*OPENCV, *NETWORKS]
    for name, row in means.items():
        missing = [column for column, value in row.items() if value == "nan"]
        assert missing == (["calibration_error"] if name in OPENCV else [])
    assert 5 < float(means["small"]["memory_mb"]) < 500
    assert all(file.read_bytes().startswith(b"\x89PNG") for file in out.glob("*.png"))
    assert sorted(file.name for file in out.iterdir()) == ["curves.png", "rows.csv", "time.png"]
    printed = capfd.readouterr().out
    assert printed.endswith(f"rows: {out}/rows.csv\n")
    assert [name for name in (*OPENCV, "flying %", "AUSE px") if name not in printed] == []
    assert max(map(len, printed.splitlines()[:-1])) <= 100


@pytest.mark.parametrize(
    ("options", "fragments"),
    [
        ("--plot time.words", ["time.words: expected a picture file extension", "found .words"]),
        ("--sparsification words", ["words: expected a picture file extension"]),
        ("--dataset words", ["dataset: expected one of", "'words'"]),
        ("--dataset kitti2015", ["expected a dataset folder"]),
        ("--cluster 127.0.0.1:1", ["127.0.0.1:1: expected the head of a Ray cluster"]),
    ],
)
def test_a_mistake_is_reported_in_one_line_before_anything_is_measured(
    sets, tmp_path, monkeypatch, capfd, options, fragments
):
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert main(f"bench pairs {sets} {options}".split()) == 2
    printed, told = capfd.readouterr()
    assert printed == ""
    (line,) = told.splitlines()
    assert [fragment for fragment in fragments if fragment not in line] == []
    assert sorted(tmp_path.rglob("*")) == before


def test_errors_by_class_are_a_second_file_and_add_up_to_the_first(sets, tmp_path, capfd, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    out = tmp_path / "out"
    options = f"-o {out}/rows.csv --classes {out}/classes.csv --model small --threads 1"
    assert main(f"bench pairs {sets / 'ship'} {options}".split()) == 0
    text = (out / "classes.csv").read_text()
    assert text.splitlines()[0] == (
        "matcher,scene,pixel_class,share_percent,bad1_percent,bad2_percent,bad1_within_percent,"
        "bad2_within_percent,epe_px,cpu,cores,opencv"
    )
    by_class = {}
    for row in csv.DictReader(text.splitlines()):
        by_class.setdefault((row["matcher"], row["scene"]), {})[row["pixel_class"]] = row
    whole = list(csv.DictReader((out / "rows.csv").read_text().splitlines()))
    assert list(by_class) == [
        (matcher, scene)
        for scene in ("ship-000000", "ship-000001", "mean")
        for matcher in (*OPENCV, "small", "small refined")
    ]
    for row in whole:
        found = by_class[row["matcher"], row["scene"]]
        assert list(found) == [*CLASSES, "all"]
        points = sum(float(found[name]["bad1_percent"]) for name in CLASSES)
        assert points == pytest.approx(float(row["bad1_percent"]), abs=1e-3)
        assert float(found["all"]["epe_px"]) == pytest.approx(float(row["epe_px"]), rel=1e-5)
    printed = capfd.readouterr().out
    assert f"errors by class: {out}/classes.csv\n" in printed
    assert [name for name in ("outside", "occluded", "edges", "plain", "weak") if name not in printed] == []
    assert "…" not in printed


def test_rendered_pairs_have_an_occlusion_mask_and_folders_do_not(sets, tmp_path):
    for number, scene in enumerate(read_scenes(sets / "ship")):
        np.testing.assert_array_equal(scene.occluded, pair(number).occluded)
    made = pair(0)
    folder = tmp_path / "scenes" / "box"
    folder.mkdir(parents=True)
    for name, image in (("left", made.left), ("right", made.right)):
        write_image(folder / f"{name}.png", image)
    write_pfm(folder / "disparity.pfm", made.disparity_px)
    (scene,) = read_scenes(tmp_path / "scenes")
    assert scene.occluded is None


def test_held_out_collages_are_a_set_of_the_pairs_that_trainings_validate_on(tmp_path, capfd):
    assert main(f"bench collages -o {tmp_path}/collages --pairs 2 --size 64x48".split()) == 0
    assert capfd.readouterr().out == f"{tmp_path}/collages: 2 pairs made\n"
    for number, scene in enumerate(read_scenes(tmp_path / "collages")):
        expected = collage.paint_collage(VALIDATION_SEED, 0, number, 48, 64)
        assert scene.name == f"collage-{number:06d}"
        np.testing.assert_array_equal(scene.pair.left, expected.left)
        np.testing.assert_array_equal(scene.pair.right, expected.right)
        np.testing.assert_allclose(scene.truth_px, expected.disparity_px, atol=0.001)
        np.testing.assert_array_equal(scene.occluded, expected.occluded)


@pytest.mark.parametrize(
    ("options", "fragment"),
    [
        ("--size 640", "--size: expected width x height in pixels"),
        ("--size 64x16", "--size: expected at least 32x32 pixels, found 64x16"),
        ("--size 64x48", "expected a new or empty folder"),
    ],
)
def test_collages_are_not_written_among_other_files_or_tiny(sets, capfd, options, fragment):
    before = sorted(sets.rglob("*"))
    assert main(f"bench collages -o {sets} {options}".split()) == 2
    assert fragment in capfd.readouterr().err
    assert sorted(sets.rglob("*")) == before


def test_collages_are_not_written_where_another_command_is_writing(tmp_path, capfd):
    with lock_output(tmp_path):
        assert main(f"bench collages -o {tmp_path} --pairs 2 --size 64x48".split()) == 2
    assert "found one that is in use" in capfd.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_plot_without_matplotlib_names_the_extra(tmp_path):
    program = (
        "import sys; sys.modules['matplotlib'] = None; from stereoweave.cli.root import main; "
        "sys.exit(main(['bench', 'pairs', 'nowhere', '--plot', 'time.png']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "a plot needs matplotlib, but the module matplotlib.axes is not installed" in line
    assert 'pip install "stereoweave[train]"' in line
    assert list(tmp_path.iterdir()) == []
