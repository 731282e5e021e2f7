"""Large batches on a real Ray: what is made, what a bad pair or a killed process costs, and going on."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import fsspec
import pyarrow.dataset
import pytest
from conftest import processes_of

from stereoweave import cluster_worker
from stereoweave.cli import main
from stereoweave.cluster import run_cluster
from stereoweave.cluster_worker import Worker
from stereoweave.engine import Engine, connect
from stereoweave.errors import StereoweaveError
from stereoweave.io import read_image, read_pfm, write_image
from stereoweave.manifest import extend_plan, read_rows
from stereoweave.matcher import Matcher
from stereoweave.results import DepthOrder, make_depth
from stereoweave.stores import store_at

EXAMPLES = Path(__file__).parent.parent / "examples"
ORDER = DepthOrder(always=("disparity.pfm", "confidence.png"))


@pytest.fixture(scope="module")
def engine(ray_address):
    engine = Engine(ray_address, workers=2)
    with connect(engine):
        yield engine


def write_pairs(folder: Path, names, size_px=(64, 48)) -> Path:
    """Small pairs, each another part of the example."""
    width, height = size_px
    for side in ("left", "right"):
        image = read_image(EXAMPLES / f"{side}.png")
        for index, name in enumerate(names):
            crop = image[3 * index :][:height, 200 : 200 + width]
            write_image(folder / side / f"{name}.png", crop)
    return folder


def numbered(count: int) -> list[str]:
    return [f"{index:02d}" for index in range(count)]


def manifest(out: str | Path) -> dict[str, dict]:
    """The rows of all parts, read as others would, each pair once."""
    files, path = fsspec.url_to_fs(str(out))
    rows = pyarrow.dataset.dataset(f"{path}/manifest", filesystem=files).to_table().to_pylist()
    assert len({row["pair"] for row in rows}) == len(rows)
    return {row["pair"]: row for row in rows}


def made_at_ns(out: Path) -> dict[str, int]:
    return {path.parent.name: path.stat().st_mtime_ns for path in out.glob("*/disparity.pfm")}


def test_bad_pairs_become_rows_and_the_next_run_makes_what_is_missing_changed_or_new(engine, tmp_path):
    source, out = write_pairs(tmp_path / "pairs", numbered(8)), tmp_path / "out"
    write_image(source / "left" / "alone.png", read_image(source / "left" / "00.png"))
    bad, odd = source / "right" / "01.png", source / "right" / "02.png"
    whole = {path: path.read_bytes() for path in (bad, odd)}
    bad.write_bytes(whole[bad][:500])
    write_image(odd, read_image(odd)[:-4])
    tally = run_cluster(source, out, ORDER, engine)
    assert (tally.made, tally.there, tally.failed, tally.manifest) == (6, 0, 3, str(out / "manifest"))
    rows = manifest(out)
    assert list(sorted(rows)) == [*numbered(8), "alone"]
    assert str(bad) in rows["01"]["error"]
    assert "of one size, found" in rows["02"]["error"]
    assert rows["alone"]["error"].endswith(
        "alone.png: expected a picture (PNG, JPEG, TIFF or the like), found no such file"
    )
    assert dict(tally.named) == {name: rows[name]["error"] for name in ("01", "02", "alone")}

    pictures = [source / side / "03.png" for side in ("left", "right")]
    summary, notes = make_depth(pictures, tmp_path / "alone", ORDER, Matcher(threads=1))
    for file in ORDER.always:
        assert (out / "03" / file).read_bytes() == (tmp_path / "alone" / file).read_bytes()
    row = rows["03"]
    assert (row["width_px"], row["height_px"], row["error"]) == (64, 48, None)
    assert row["disparity_median_px"] == pytest.approx(summary.disparity_median_px)
    assert row["confident_percent"] == pytest.approx(summary.confident_percent)
    assert (row["pictures"], row["checks"]) == (["03.png", "03.png"], notes)

    before = made_at_ns(out)
    for path, content in whole.items():
        path.write_bytes(content)
    (source / "left" / "alone.png").unlink()
    write_image(source / "left" / "04.png", read_image(source / "left" / "05.png"))
    (out / "06" / "confidence.png").unlink()
    write_pairs(source, ["new"])
    tally = run_cluster(source, out, ORDER, engine)
    assert (tally.made, tally.there, tally.failed) == (5, 4, 1)  # 01, 02, 04, 06, new; alone is still missing
    after = made_at_ns(out)
    assert {name for name in after if after[name] != before.get(name)} == {"01", "02", "04", "06", "new"}
    rows = manifest(out)
    assert {name for name, row in rows.items() if row["error"]} == {"alone"}
    assert set(rows) == {*numbered(8), "alone", "new"}
    assert not list((out / "begun").iterdir())


def test_killed_workers_and_a_killed_driver_lose_nothing_and_double_nothing(ray_address, engine, tmp_path):
    names = numbered(40)
    source, out = write_pairs(tmp_path / "pairs", names, (256, 192)), tmp_path / "out"
    program = "import sys; from stereoweave.cli import main; sys.exit(main())"
    words = ["batch", str(source), str(out), "--address", ray_address, "--workers", "2"]
    driver = subprocess.Popen([sys.executable, "-c", program, *words], stderr=subprocess.DEVNULL)

    def parts() -> int:
        return len(list((out / "manifest").glob("part-*.parquet")))

    def wait_for(count: int) -> None:
        while parts() < count and driver.poll() is None:
            time.sleep(0.01)

    wait_for(2)
    workers = [process for process in processes_of(os.getpid()) if b"MapWorker" in command_of(process)]
    os.kill(workers[0], signal.SIGKILL)
    wait_for(6)
    driver.kill()
    assert driver.wait() == -signal.SIGKILL
    assert 6 <= parts() < 20
    kept = made_at_ns(out)
    complete = set(manifest(out))

    order = DepthOrder()
    tally = run_cluster(source, out, order, engine)
    assert (tally.made + tally.there, tally.failed) == (40, 0)
    assert tally.there >= len(complete) > 0
    rows = manifest(out)
    assert sorted(rows) == names
    assert not any(row["error"] for row in rows.values())
    now = made_at_ns(out)
    assert {name: now[name] for name in complete} == {name: kept[name] for name in complete}
    for name in names:
        assert read_pfm(out / name / "disparity.pfm").shape == (192, 256)
        assert read_image(out / name / "preview.png").shape == (192, 256, 3)


def command_of(process: int) -> bytes:
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return b""


class Deadly(Worker):
    """A worker whose process is killed by the pair 01."""

    def row(self, planned):
        if planned.name == "01":
            os.kill(os.getpid(), signal.SIGKILL)
        return super().row(planned)


def test_a_pair_that_kills_its_process_becomes_a_row_and_costs_no_other(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster_worker, "_MOST_TRIES", 2)
    source, out = store_at(write_pairs(tmp_path / "pairs", numbered(3))), store_at(tmp_path / "out")
    monkeypatch.setattr("stereoweave.manifest._CHUNKS_OF_A_WORKER", 1)
    [first] = extend_plan(source, out, workers=1).chunks
    out.write_bytes(f"begun/{first:08d}.json", b"{}")  # as the worker leaves it that is killed with the pair
    counts = Deadly(source, out, ORDER)([first])
    assert (counts.made, counts.failed) == (2, 1)
    rows = read_rows(out, first)
    assert [row["error"] for row in rows.values()] == [
        None,
        "its process was killed every time; is the memory full?",
        None,
    ]
    assert not out.exists(f"begun/{first:08d}.json")


def test_another_runs_destination_is_refused_and_so_is_a_source_with_nothing_in_it(engine, tmp_path):
    source, out = write_pairs(tmp_path / "pairs", ["00"]), tmp_path / "out"
    assert run_cluster(source, out, ORDER, engine).made == 1
    with pytest.raises(StereoweaveError, match=r"batch.json: expected always = .*, found .* another folder"):
        run_cluster(source, out, DepthOrder(), engine)
    other = write_pairs(tmp_path / "other", ["00"])
    with pytest.raises(StereoweaveError, match=r"batch.json: expected source = .*other.*, found .*pairs"):
        run_cluster(other, out, ORDER, engine)
    with pytest.raises(StereoweaveError, match=r"other: expected a new folder, or one with a batch.json"):
        run_cluster(source, other, ORDER, engine)
    with pytest.raises(StereoweaveError, match="none: expected a folder, found no such folder"):
        run_cluster(tmp_path / "none", tmp_path / "new", ORDER, engine)
    (tmp_path / "empty").mkdir()
    with pytest.raises(StereoweaveError, match="expected pairs of pictures or films in it, found none"):
        run_cluster(tmp_path / "empty", tmp_path / "new", ORDER, engine)


def test_pairs_go_from_a_bucket_to_a_bucket_with_a_calibration_and_a_bad_one_is_told_by_its_url(
    engine, bucket, tmp_path
):
    local = write_pairs(tmp_path / "pairs", numbered(3))
    (local / "right" / "02.png").write_bytes(b"none")
    store = store_at(f"{bucket}/in")
    for path in local.rglob("*.png"):
        store.put(path, path.relative_to(local).as_posix())
    for name in ("left.png", "right.png", "calib.txt"):
        store.put(EXAMPLES / name, f"room/{name}")
    tally = run_cluster(f"{bucket}/in", f"{bucket}/out", ORDER, engine)
    assert (tally.made, tally.failed, tally.manifest) == (3, 1, f"{bucket}/out/manifest")
    rows = manifest(f"{bucket}/out")
    assert rows["02"]["error"].startswith(f"{bucket}/in/right/02.png: expected a picture")
    assert "depth.png" in rows["room"]["files"]
    out = store_at(f"{bucket}/out")
    pictures = [local / side / "00.png" for side in ("left", "right")]
    make_depth(pictures, tmp_path / "alone", ORDER, Matcher(threads=1))
    for file in ORDER.always:
        assert out.read_bytes(f"00/{file}") == (tmp_path / "alone" / file).read_bytes()
    tally = run_cluster(f"{bucket}/in", f"{bucket}/out", ORDER, engine)
    assert (tally.made, tally.there, tally.failed) == (0, 3, 1)
    with pytest.raises(StereoweaveError, match="expected a bucket, found none that is called nobodys"):
        run_cluster("s3://nobodys/in", f"{bucket}/new", ORDER, engine)


def test_the_command_tells_how_it_went(engine, tmp_path, capsys):
    source, out = write_pairs(tmp_path / "pairs", numbered(2)), tmp_path / "out"
    (source / "left" / "01.png").write_bytes(b"none")
    assert main(["batch", str(source), str(out), "--workers", "2"]) == 1
    told = capsys.readouterr()
    assert told.out.splitlines()[0] == f"{out}: 2 pairs: 1 made, 1 failed"
    assert told.out.splitlines()[1].startswith(f"failed: 01: {source}/left/01.png: expected a picture")
    assert told.out.splitlines()[2] == f"manifest: {out / 'manifest'}"
    assert main(["batch", str(source), str(out), "--json"]) == 1
    facts = json.loads(capsys.readouterr().out)
    assert (facts["made"], facts["there"], facts["failed"], list(facts["named"])) == (0, 1, 1, ["01"])
