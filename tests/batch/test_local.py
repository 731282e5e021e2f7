"""Batches with real processes: results, bad pairs, killed processes, and resumption."""

import csv
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from other_processes import halted
from rich.console import Console

from stereoweave.batch.local import DONE_FILE, LocalTally, run_batch, run_batch_command
from stereoweave.cli.root import main
from stereoweave.errors import OutputInUseError, StereoweaveError
from stereoweave.io.images import read_image, write_image
from stereoweave.io.maps import read_pixels
from stereoweave.matching.backend import Backend, _load
from stereoweave.matching.matcher import model_file
from stereoweave.outputs.results import DepthJob, make_depth
from stereoweave.pictures.pair_finding import FoundPairs, NamedPair, find_pairs_in
from stereoweave.pictures.prepare import Request
from stereoweave.system.threads import usable_cores

pytestmark = pytest.mark.system

TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"
JOB = DepthJob(backend=Backend(threads=1), always=("disparity.pfm", "preview.png", "confidence.png"))
PROGRAM = """
import sys
from pathlib import Path
from stereoweave.batch.local import run_batch_command
from stereoweave.matching.backend import Backend
from stereoweave.pictures.pair_finding import find_pairs_in
from stereoweave.outputs.results import DepthJob

if __name__ == "__main__":
    job = DepthJob(backend=Backend(threads=1), always=("disparity.pfm", "preview.png", "confidence.png"))
    sys.exit(run_batch_command(find_pairs_in(Path(sys.argv[1])), Path(sys.argv[2]), job, processes=2))
"""


class KillingPair(NamedPair):
    """A pair that kills the process to which it is sent."""

    def __reduce__(self):
        return os.kill, (_OwnPid(), signal.SIGKILL)


class ThreadRecordingPair(NamedPair):
    """A pair that records the number of threads of its process in a file beside its left picture."""

    def __reduce__(self):
        return record_threads, (self.name, self.pictures)


def record_threads(name: str, pictures: tuple[Path, ...]) -> NamedPair:
    threads = cv2.getNumThreads(), os.environ["OPENBLAS_NUM_THREADS"]
    pictures[0].with_suffix(".txt").write_text("{} {}".format(*threads))
    return NamedPair(name, pictures)


class ModelRemover(NamedPair):
    """A pair that replaces the model file by an invalid one when it arrives in another process."""

    def __reduce__(self):
        return remove_model, (self.name, self.pictures)


def remove_model(name: str, pictures: tuple[Path, ...]) -> NamedPair:
    (pictures[0].parents[1] / "model.onnx").write_bytes(b"no network")
    return NamedPair(name, pictures)


class _OwnPid:
    """Stand-in for a process ID: unpickling it gives the ID of the current process."""

    def __reduce__(self):
        return os.getpid, ()


def write_pairs(folder: Path, count: int, size_px=(96, 64)) -> Path:
    """Write small pairs 00, 01, ..., each a different crop of the example, and return their folder."""
    width, height = size_px
    for side in ("left", "right"):
        (folder / side).mkdir(parents=True)
        image = read_image(TEXTURED / f"{side}.png")
        for index in range(count):
            write_image(folder / side / f"{index:02d}.png", image[4 * index :][:height, 200 : 200 + width])
    return folder


def run_quietly(folder: Path, out: Path, job: DepthJob = JOB, **options) -> tuple[LocalTally, str]:
    """Run a batch, and return its tally and its console output."""
    shown = io.StringIO()
    options.setdefault("pairs", find_pairs_in(folder).pairs)
    return run_batch(out=out, job=job, console=Console(file=shown), **options), shown.getvalue()


def read_write_times_ns(out: Path) -> dict[str, int]:
    return {path.parent.name: path.stat().st_mtime_ns for path in out.glob(f"*/{DONE_FILE}")}


def read_summary(out: Path) -> dict[str, dict[str, str]]:
    with (out / "summary.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len({row["name"] for row in rows}) == len(rows)
    return {row["name"]: row for row in rows}


def test_a_bad_pair_is_reported_and_the_next_run_processes_only_unfinished_and_changed_pairs(
    tmp_path,
):
    folder, out = write_pairs(tmp_path / "pairs", 4), tmp_path / "out"
    bad = folder / "right" / "01.png"
    whole = bad.read_bytes()
    bad.write_bytes(whole[:3000])
    start_s = time.perf_counter()
    tally, shown = run_quietly(folder, out, processes=2)
    elapsed_s = time.perf_counter() - start_s
    [(name, reason)] = tally.failed
    assert (tally.done, tally.skipped, name) == (3, 0, "01")
    assert str(bad) in reason
    assert f"01: {reason}\n" in shown

    make_depth((folder / "left" / "02.png", folder / "right" / "02.png"), tmp_path / "alone", JOB)
    for file in ("disparity.pfm", "preview.png", "confidence.png"):
        assert (out / "02" / file).read_bytes() == (tmp_path / "alone" / file).read_bytes()
    rows = read_summary(out)
    assert list(rows) == ["00", "01", "02", "03"]
    assert rows["01"]["error"] == reason
    assert rows["02"]["pictures"] == "02.png + 02.png"
    assert 0 < float(rows["02"]["seconds"]) < elapsed_s

    before = read_write_times_ns(out)
    bad.write_bytes(whole)
    write_image(folder / "left" / "03.png", read_image(folder / "left" / "03.png")[::-1])
    (out / "00" / "disparity.pfm").unlink()
    tally, shown = run_quietly(folder, out, processes=1)
    assert tally == LocalTally(
        done=3, skipped=1, failed=(), warned=("03",)
    )  # its left picture is upside down
    after = read_write_times_ns(out)
    assert {name for name in after if after[name] != before.get(name)} == {"00", "01", "03"}
    assert [row["error"] for row in read_summary(out).values()] == [""] * 4
    assert sorted(path.name for path in out.iterdir()) == [
        "00",
        "01",
        "02",
        "03",
        "batch.json",
        "summary.csv",
    ]


def test_a_finished_pair_that_fails_in_a_later_run_is_no_longer_finished(tmp_path):
    folder, out = write_pairs(tmp_path / "pairs", 2), tmp_path / "out"
    assert run_quietly(folder, out, processes=1)[0].done == 2
    first, second = find_pairs_in(folder).pairs
    second.pictures[1].write_bytes(b"no picture")
    tally, _ = run_quietly(folder, out, processes=1)
    assert [name for name, _ in tally.failed] == ["01"]
    assert list(read_write_times_ns(out)) == ["00"]
    run_quietly(folder, out, pairs=[first], processes=1)
    assert list(read_summary(out)) == ["00"]


def test_a_pair_counts_as_finished_only_if_its_pictures_and_done_file_are_intact(tmp_path, capsys):
    folder, out = write_pairs(tmp_path / "pairs", 3), tmp_path / "out"
    out.mkdir()
    (out / ".DS_Store").touch()  # a folder that holds only this file counts as new
    pairs = find_pairs_in(folder).pairs
    assert run_quietly(folder, out, processes=1)[0].done == 3
    (out / "00" / DONE_FILE).write_text("{")
    pairs[1].pictures[0].unlink()
    tally, _ = run_quietly(folder, out, pairs=pairs, processes=1)
    assert (tally.done, tally.skipped, [name for name, _ in tally.failed]) == (1, 1, ["01"])
    assert run_batch_command(FoundPairs(pairs[:1], ("a note",)), out, JOB) == 0
    printed = capsys.readouterr()
    assert printed.out.splitlines()[0] == f"{out}: 1 pair: 0 made, 1 already there"
    assert printed.err.splitlines()[0] == "a note"


@pytest.mark.parametrize(("processes", "threads"), [(2, 1), (1, usable_cores())])
def test_several_processes_use_one_thread_each_and_a_single_process_uses_all_cores(
    tmp_path, monkeypatch, processes, threads
):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "7")
    folder = write_pairs(tmp_path / "pairs", 2)
    pairs = [ThreadRecordingPair(pair.name, pair.pictures) for pair in find_pairs_in(folder).pairs]
    job = DepthJob(always=("disparity.pfm",))
    assert run_quietly(folder, tmp_path / "out", job, pairs=pairs, processes=processes)[0].done == 2
    notes = [pair.pictures[0].with_suffix(".txt").read_text() for pair in pairs]
    assert notes == [f"{threads} {threads}"] * 2
    assert os.environ["OPENBLAS_NUM_THREADS"] == "7"


def test_a_killed_or_interrupted_batch_resumes_but_not_while_another_one_runs(tmp_path, capsys):
    folder, out = write_pairs(tmp_path / "pairs", 24, (256, 192)), tmp_path / "out"
    before = {}
    for end, goal in ((signal.SIGKILL, 3), (signal.SIGINT, 8)):
        process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, folder, out],
            start_new_session=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # If a shell starts the tests in the background, their child processes ignore Ctrl-C by default.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
        while len(read_write_times_ns(out)) < goal and process.poll() is None:
            time.sleep(0.002)
        with halted(process):
            with pytest.raises(OutputInUseError, match=f"{out}: .* found one that is in use"):
                run_quietly(folder, out)
            os.killpg(process.pid, end)
        output, errors = process.communicate()
        made = read_write_times_ns(out)
        assert goal <= len(made) < 24
        assert made.items() >= before.items()
        before = made
    assert process.returncode == 130
    assert output == ""
    assert errors.splitlines()[-1] == (
        f"stereoweave: {out}: stopped; finished results are kept; rerun the same command to resume"
    )
    assert "Traceback" not in errors
    assert not list(out.glob(".*"))

    assert run_batch_command(find_pairs_in(folder), out, JOB, processes=2) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"{out}: 24 pairs: {24 - len(before)} made, {len(before)} already there",
        f"table: {out / 'summary.csv'}",
    ]
    assert read_write_times_ns(out).items() >= before.items()
    names = [f"{index:02d}" for index in range(24)]
    assert sorted(read_write_times_ns(out)) == names
    assert list(read_summary(out)) == names
    assert not list(out.rglob(".*"))


def test_files_left_by_killed_processes_are_removed_by_the_next_run(tmp_path):
    pairs, out = find_pairs_in(write_pairs(tmp_path / "pairs", 1)), tmp_path / "out"
    assert run_batch_command(pairs, out, JOB, processes=1) == 0
    # The last name looks like that of a temporary file.
    for folder in (out / ".stereoweave-x1", out / "00/.stereoweave-x2", out / "00/.stereoweave-0123abcd"):
        folder.mkdir()
        (folder / "cloud.ply").touch()
    assert run_batch_command(pairs, out, JOB, processes=1) == 0
    assert not list(out.rglob(".*"))


def test_pairs_with_warnings_are_counted_and_the_table_has_the_warnings(tmp_path, capsys):
    folder, out = write_pairs(tmp_path / "pairs", 8), tmp_path / "out"
    for name in [f"{index:02d}.png" for index in range(1, 7)]:
        upside_down = read_image(folder / "right" / name)[::-1]
        write_image(folder / "right" / name, upside_down)
    assert run_batch_command(find_pairs_in(folder), out, JOB, processes=2) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"{out}: 8 pairs: 8 made",
        "with warnings: 6 (01, 02, 03, 04, 05, ...); see the column warnings of the table",
        f"table: {out / 'summary.csv'}",
    ]
    rows = read_summary(out)
    assert rows["01"]["warnings"].startswith("expected two pictures of the same scene, found ")
    assert [rows[name][column] for name in ("00", "07") for column in ("warnings", "notes")] == [""] * 4


def test_a_pair_that_kills_its_process_is_named_and_affects_no_other_pair(tmp_path, capsys):
    folder, out = write_pairs(tmp_path / "pairs", 3), tmp_path / "out"
    first, second, third = find_pairs_in(folder).pairs
    pairs = [first, KillingPair(second.name, second.pictures), third]
    assert run_batch_command(FoundPairs(pairs), out, JOB, processes=2, as_json=True) == 1
    printed = capsys.readouterr()
    assert json.loads(printed.out) == {
        "done": 2,
        "skipped": 0,
        "failed": {"01": "its process was killed; did it run out of memory?"},
        "warned": [],
        "summary": str(out / "summary.csv"),
    }
    assert "01: its process was killed" in printed.err
    assert sorted(read_write_times_ns(out)) == ["00", "02"]


def test_a_model_file_replaced_during_a_batch_is_not_loaded(tmp_path):
    folder, out = write_pairs(tmp_path / "pairs", 2), tmp_path / "out"
    model = Path(shutil.copy(model_file("small"), folder / "model.onnx"))
    first, second = find_pairs_in(folder).pairs
    pairs = [first, ModelRemover(second.name, second.pictures)]
    job = replace(JOB, backend=Backend(model=model, threads=1))
    _load.cache_clear()
    assert run_quietly(folder, out, job, pairs=pairs, processes=1)[0] == LocalTally(2, 0, (), ())
    assert model.read_bytes() == b"no network"
    assert _load.cache_info().currsize == 0  # this process matches nothing


def test_another_job_or_an_unrelated_folder_is_refused_before_processing_starts(tmp_path):
    folder, out = write_pairs(tmp_path / "pairs", 1), tmp_path / "out"
    calibration = tmp_path / "calib.txt"
    calibration.write_text("first")
    job = DepthJob(request=Request(calibration=calibration))
    assert run_quietly(folder, out, job, pairs=[])[0] == LocalTally(done=0, skipped=0, failed=(), warned=())
    with pytest.raises(
        StereoweaveError, match='batch.json: expected model = "base" for this run, found "small"'
    ):
        run_quietly(
            folder, out, DepthJob(request=Request(calibration=calibration), backend=Backend(model="base"))
        )
    calibration.write_text("second")
    with pytest.raises(
        StereoweaveError, match=r"calibration = .calib.txt \w{12}. for this run, .* another folder"
    ):
        run_quietly(folder, out, job)
    with pytest.raises(
        StereoweaveError, match="expected an empty folder or one with a batch.json, found one with left"
    ):
        run_quietly(folder, folder)
    with pytest.raises(StereoweaveError, match="nonsense"):
        run_quietly(folder, tmp_path / "new", DepthJob(backend=Backend(model="nonsense")))
    assert not (tmp_path / "new").exists()


def test_a_scenes_own_calibration_is_used_unless_one_is_given_for_all_scenes(tmp_path):
    folder, out = tmp_path / "scenes", tmp_path / "out"
    (folder / "room").mkdir(parents=True)
    for name in ("left.png", "right.png", "calib.txt"):
        (folder / "room" / name).write_bytes((TEXTURED / name).read_bytes())
    tally, _ = run_quietly(folder, out, processes=1)
    assert tally == LocalTally(done=1, skipped=0, failed=(), warned=())
    own_mm = read_pixels(out / "room" / "depth.png", "I;16")

    calibration = tmp_path / "twice.txt"
    words = (TEXTURED / "calib.txt").read_text().replace("baseline=100", "baseline=200")
    calibration.write_text(words)
    job = DepthJob(request=Request(calibration=calibration))
    run_quietly(folder, tmp_path / "other", job, processes=1)
    other_mm = read_pixels(tmp_path / "other" / "room" / "depth.png", "I;16")
    known = (own_mm > 0) & (other_mm > 0)
    assert known.mean() > 0.9
    assert np.median(other_mm[known] / own_mm[known]) == pytest.approx(2, rel=1e-3)


def test_a_focal_length_and_a_baseline_replace_a_scenes_own_calibration(tmp_path):
    folder = tmp_path / "scenes"
    (folder / "room").mkdir(parents=True)
    for name in ("left.png", "right.png", "calib.txt"):
        (folder / "room" / name).write_bytes((TEXTURED / name).read_bytes())
    job = DepthJob(request=Request(focal_px=500.0, baseline_m=0.1))
    tally, _ = run_quietly(folder, tmp_path / "out", job, processes=1)
    assert tally == LocalTally(done=1, skipped=0, failed=(), warned=())
    disparity_px = read_pixels(tmp_path / "out" / "room" / "disparity.png", "I;16") / 256
    depth_mm = read_pixels(tmp_path / "out" / "room" / "depth.png", "I;16")
    seen = (disparity_px > 1) & (depth_mm > 0)
    np.testing.assert_allclose((depth_mm * disparity_px)[seen], 1000 * 500 * 0.1, rtol=0.01)


def test_the_command_takes_a_list_and_writes_reports_only_on_request(tmp_path, capsys):
    folder, out = write_pairs(tmp_path / "pairs", 2), tmp_path / "out"
    (folder / "list.txt").write_text("left/00.png right/00.png quay\nleft/01.png right/none.png\n")
    words = ["depth", "--list", str(folder / "list.txt"), "--jobs", "1", "--threads", "1", "-o"]
    assert main([*words, str(out)]) == 1
    printed = capsys.readouterr()
    reason = f"01: {folder / 'right' / 'none.png'}: expected a picture, found no such file"
    assert printed.out.splitlines() == [
        f"{out}: 2 pairs: 1 made, 1 failed",
        f"failed: {reason}",
        f"table: {out / 'summary.csv'}",
    ]
    assert reason in printed.err
    assert (out / "quay" / "disparity.pfm").exists()
    assert not (out / "quay" / "report.html").exists()
    assert main([*words, str(tmp_path / "reports"), "--write", "report.html"]) == 1
    report = (tmp_path / "reports" / "quay" / "report.html").read_text(encoding="utf-8")
    assert "stereoweave depth --list" in report
    assert 'href="disparity.pfm"' in report
    assert main([*words, str(out), "--left", "*.png"]) == 2
    assert "found patterns and a list; give exactly one of them (--left, --right, --list)" in (
        capsys.readouterr().err
    )
