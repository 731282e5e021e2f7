"""Sets and scores made by a cluster's workers: the same as those made by one process."""

import csv
import io
import os
import platform
import signal
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from dataset_examples import error_of
from rich.console import Console
from shard_examples import PaintedPairMaker, box_before_a_wall, contents

from stereoweave.bench import pairs as benchmark
from stereoweave.bench.pairs import make_matcher, score_pairs
from stereoweave.bench.tables import write_csv
from stereoweave.cli.root import main
from stereoweave.data.packing import pack
from stereoweave.data.readers import list_scenes
from stereoweave.data.shards import write_shard
from stereoweave.errors import StereoweaveError
from stereoweave.synth.sets import make as making
from stereoweave.synth.sets.make import make
from stereoweave.synth.sets.pair_rendering import RenderSpec
from stereoweave.system.ray_engine import Engine, connect

pytestmark = pytest.mark.system

SPEC = RenderSpec(scene="pylon", seed=3, size_px=(48, 32))
PAIR_MAKER = PaintedPairMaker()
MEASURED = {"time_ms", "time_relative", "memory_mb"}


@dataclass(frozen=True)
class KilledOnce(PaintedPairMaker):
    """A pair maker whose process is killed at its first attempt at pair 6."""

    note: Path = Path()

    def __call__(self, spec, index):
        if index == 6 and not self.note.exists():
            self.note.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().__call__(spec, index)


@dataclass(frozen=True)
class KeptToItself(PaintedPairMaker):
    """A pair maker that removes its first shard before later pairs, as if only its machine had seen it."""

    out: Path = Path()

    def __call__(self, spec, index):
        if index >= 4:
            # Tasks may run twice, and on a busy machine in another order.
            (self.out / "pylon-000000-000003.tar").unlink(missing_ok=True)
        return super().__call__(spec, index)


@pytest.fixture(scope="module")
def cluster(ray_address):
    """Yield the cluster's address; this process stays its driver for all tests of this module."""
    with connect(Engine(ray_address)):
        yield ray_address


@pytest.fixture(autouse=True)
def small_shards(monkeypatch):
    monkeypatch.setitem(making.LAYOUTS, "shards", making.LAYOUTS["shards"]._replace(pairs_a_run=4))


def made(out, pairs=10, pair_maker=PAIR_MAKER, engine=None):
    return make(SPEC, pairs, out, engine=engine, pair_maker=pair_maker, console=Console(file=io.StringIO()))


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    """Return a folder of two sets, each with one pair and an additional view."""
    folder = tmp_path_factory.mktemp("sets")
    for number, name in enumerate(("crane", "ship")):
        sample = box_before_a_wall(np.random.default_rng(number), (96, 64))
        write_shard(folder / name, name, 0, [pack(sample, {0.5: sample.left})])
    return folder


# Rendered sets


def test_a_cluster_completes_a_set_to_the_same_bytes_as_one_process_despite_a_killed_worker(
    tmp_path, cluster
):
    made(tmp_path / "one")
    made(tmp_path / "many", pairs=4)
    pair_maker = KilledOnce(note=tmp_path / "killed")
    assert made(tmp_path / "many", pair_maker=pair_maker, engine=Engine(cluster)) == 6
    assert pair_maker.note.exists()
    assert contents(tmp_path / "many") == contents(tmp_path / "one")


def test_pairs_that_only_one_machine_of_the_cluster_sees_are_reported_missing(tmp_path, cluster):
    message = error_of(made, tmp_path, 10, KeptToItself(out=tmp_path), Engine(cluster, workers=1))
    assert message.startswith(
        f"{tmp_path}: expected all pairs that the cluster made, found 4 of them missing"
    )
    assert made(tmp_path) == 4


def test_a_machine_that_sees_another_folder_or_would_make_other_pairs_is_named(tmp_path):
    made(tmp_path / "set", pairs=1)
    message = error_of(making._prepare_node, SPEC, tmp_path / "nowhere", "shards", PAIR_MAKER)
    words = ["set.json: expected the description of a set", "found no such file", platform.node()]
    assert [word for word in words if word not in message] == []
    message = error_of(making._prepare_node, replace(SPEC, seed=4), tmp_path / "set", "shards", PAIR_MAKER)
    assert "expected seed = 4 for this run, found 3" in message
    assert message.endswith("on a shared disk and the same versions of all packages")


@pytest.mark.needs_egl
def test_a_cluster_renders_the_same_set_as_one_process(tmp_path, cluster, monkeypatch):
    monkeypatch.chdir(tmp_path)
    line = "synth make pylon --pairs 2 --size 48x32 --plain --jobs 1"
    assert main(f"{line} -o one".split()) == 0
    assert main(f"{line} -o many --cluster {cluster}".split()) == 0
    assert contents(tmp_path / "many") == contents(tmp_path / "one")


# Scores


def test_a_cluster_measures_the_same_disparity_errors_as_one_process(sets, tmp_path, cluster):
    line = f"bench pairs {sets} --model small --threads 1 -o {tmp_path}/many.csv --cluster {cluster}"
    assert main(line.split()) == 0
    makers = {
        "small": partial(make_matcher, "small", 1),
        "small refined": partial(make_matcher, "small", 1, True),
    }
    expected = score_pairs(makers, partial(list_scenes, sets))
    write_csv(tmp_path / "one.csv", expected.rows, expected.machine)
    many = _rows(tmp_path / "many.csv")
    assert [_errors(row) for row in many] == [_errors(row) for row in _rows(tmp_path / "one.csv")]
    assert len(many) == 3 * 6
    assert all(float(row["time_ms"]) > 0 for row in many)


def test_a_cluster_measures_the_same_view_errors_as_one_process(sets, tmp_path, cluster):
    line = f"bench views {sets} --model small --threads 1"
    assert main(f"{line} -o {tmp_path}/one.csv".split()) == 0
    assert main(f"{line} -o {tmp_path}/many.csv --cluster {cluster}".split()) == 0
    one, many = (list(map(_errors, _rows(tmp_path / name))) for name in ("one.csv", "many.csv"))
    assert many == one
    assert len(many) == 3 * 6


def test_a_machine_that_sees_other_scenes_is_named(sets):
    with pytest.raises(StereoweaveError) as raised:
        benchmark._SceneScorer({}, partial(list_scenes, sets), len, expected=3)
    assert str(raised.value) == (
        f"{platform.node()}: expected the same 3 scenes as on the machine that started the command, found 2; "
        "put them on a disk that every node of the cluster can read"
    )


def test_machines_that_differ_are_named_side_by_side():
    machines = [{"cpu": "B", "cores": "2"}, {"cpu": "A", "cores": "2"}, {"cpu": "B", "cores": "2"}]
    scored = [benchmark.SceneResult(number, None, machine) for number, machine in enumerate(machines)]
    assert benchmark.merge_machines(scored) == {"cpu": "A + B", "cores": "2"}


def _rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _errors(row):
    return {name: value for name, value in row.items() if name not in MEASURED}
