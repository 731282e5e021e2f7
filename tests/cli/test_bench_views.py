import csv

import numpy as np
import pytest
from shard_examples import box_before_a_wall

from stereoweave.cli.root import main
from stereoweave.data.packing import pack
from stereoweave.data.shards import write_shard
from stereoweave.io.images import write_image

NETWORKS = ["base", "small", "small refined"]  # base always refines

COLUMNS = (
    "scene,position,method,psnr_db,ssim,mae,smooth_psnr_db,smooth_mae,edge_psnr_db,edge_mae,one_psnr_db,"
    "one_mae,neither_psnr_db,neither_mae,time_ms,cpu,cores,opencv"
)


@pytest.fixture
def sets(tmp_path):
    """Write two rendered sets below one folder, of one pair each, with two further views and with one."""
    for name, positions in (("crane", (0.25, 0.5)), ("ship", (0.5,))):
        sample = box_before_a_wall(np.random.default_rng(0), (96, 64))
        pair = pack(sample, {position: sample.left for position in positions})
        write_shard(tmp_path / "sets" / name, name, 0, [pair])
    return tmp_path / "sets"


def photographs(folder, *names, size=(48, 64)):
    for name in names:
        write_image(folder / f"{name}.png", np.full((*size, 3), 100, np.uint8))


def test_every_method_has_a_row_per_view_and_a_mean(sets, tmp_path, capfd, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    out = tmp_path / "out" / "views.csv"
    assert main(f"bench views {sets} -o {out} --threads 1".split()) == 0
    lines = out.read_text().splitlines()
    assert lines[0] == COLUMNS
    methods = ["nearest photograph", "cross-fade", "sgbm", "ground truth", *NETWORKS]
    rows = list(csv.DictReader(lines))
    crane, ship = "crane/crane-000000", "ship/ship-000000"
    assert [(row["scene"], row["position"], row["method"]) for row in rows] == [
        (scene, position, method)
        for scene, position in ((crane, "0.25"), (crane, "0.5"), (ship, "0.5"), ("mean", "nan"))
        for method in methods
    ]
    assert [path.name for path in out.parent.iterdir()] == ["views.csv"]
    printed = capfd.readouterr().out
    assert printed.endswith(f"rows: {out}\n")
    headings = ("smooth", "edges", "one sees", "neither", "SSIM")
    assert [name for name in (*methods, *headings) if name not in printed] == []
    assert max(map(len, printed.splitlines()[:-1])) <= 80


def test_models_can_be_chosen(sets, tmp_path):
    assert main(f"bench views {sets / 'ship'} -o {tmp_path}/views.csv --model small --threads 1".split()) == 0
    with (tmp_path / "views.csv").open() as file:
        assert [row["method"] for row in csv.DictReader(file)][4::6] == ["small", "small"]


@pytest.mark.parametrize(
    ("pictures", "fragment"),
    [
        ((), "expected subfolders with left.png, or rendered sets, found neither"),
        (
            ("left", "right"),
            "expected a reference picture, such as view_0.5.png, found no view_*.png",
        ),
        (
            ("left", "right", "view_half"),
            "a position from -1 to 2 (0 is the left camera and 1 the right one), found 'half'",
        ),
    ],
)
def test_a_folder_that_cannot_be_scored_is_reported_in_one_line(tmp_path, capfd, pictures, fragment):
    photographs(tmp_path / "sets" / "shed", *pictures)
    _refused(tmp_path, capfd, fragment)


def test_a_view_of_another_size_is_reported_in_one_line(tmp_path, capfd):
    photographs(tmp_path / "sets" / "shed", "left", "right")
    photographs(tmp_path / "sets" / "shed", "view_0.5", size=(48, 60))
    _refused(
        tmp_path, capfd, "view_0.5.png: expected 64x48 pixels, the size of the pair's pictures, found 60x48"
    )


def test_a_missing_model_is_reported_in_one_line(tmp_path, sets, capfd):
    _refused(tmp_path, capfd, "unknown model 'huge'", "--model huge")


def test_a_cluster_that_does_not_answer_is_reported_in_one_line(tmp_path, sets, capfd):
    _refused(tmp_path, capfd, "127.0.0.1:1: expected the head of a Ray cluster", "--cluster 127.0.0.1:1")


def _refused(tmp_path, capfd, fragment, options=""):
    (tmp_path / "sets").mkdir(exist_ok=True)
    assert main(f"bench views {tmp_path / 'sets'} -o {tmp_path}/views.csv {options}".split()) == 2
    printed, told = capfd.readouterr()
    assert printed == ""
    (line,) = told.splitlines()
    assert fragment in line
    assert [path.name for path in tmp_path.iterdir()] == ["sets"]
