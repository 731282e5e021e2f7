"""Large batches on a real Ray: results, bad pairs, killed processes, and resumption."""

import errno
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import av
import fsspec
import numpy as np
import pyarrow.dataset
import pytest
from other_processes import halted, list_processes
from spatial_examples import SPATIAL
from video_examples import example_pairs, packets, write_side_by_side

from stereoweave.batch import worker as cluster_worker
from stereoweave.batch.cluster import _check_folders, _read_job_files, run_cluster
from stereoweave.batch.manifest import extend_plan, read_chunk, read_rows
from stereoweave.batch.worker import FILM, ChunkWorker, remove_abandoned
from stereoweave.cameras.spherical import SphereRequest
from stereoweave.cli.root import main
from stereoweave.errors import MatcherError, OutputInUseError, ProviderError, Remedy, StereoweaveError
from stereoweave.io.images import read_image, write_image
from stereoweave.io.maps import read_pfm
from stereoweave.io.output_lock import lock_output
from stereoweave.io.stores import store_at
from stereoweave.matching.backend import Backend, _load
from stereoweave.matching.matcher import Matcher, model_file
from stereoweave.matching.options import MatchOptions
from stereoweave.outputs.results import DepthJob, make_depth
from stereoweave.pictures.prepare import Request
from stereoweave.system.ray_engine import Engine, connect
from stereoweave.video.parts import parts_folder

pytestmark = pytest.mark.system

TEXTURED = Path(__file__).resolve().parents[1] / "textured_pair"
JOB = DepthJob(always=("disparity.pfm", "confidence.png"))


@pytest.fixture(scope="module")
def engine(ray_address):
    engine = Engine(ray_address, workers=1)
    with connect(engine):
        yield engine


def write_pairs(folder: Path, names, size_px=(64, 48)) -> Path:
    """Write small pairs, each a different crop of the example, and return their folder."""
    width, height = size_px
    for side in ("left", "right"):
        image = read_image(TEXTURED / f"{side}.png")
        for index, name in enumerate(names):
            crop = image[3 * index :][:height, 200 : 200 + width]
            write_image(folder / side / f"{name}.png", crop)
    return folder


def number_names(count: int) -> list[str]:
    return [f"{index:02d}" for index in range(count)]


def read_manifest(out: str | Path) -> dict[str, dict]:
    """Return the rows of all parts by pair, read by PyArrow alone; check that each pair occurs once."""
    files, path = fsspec.url_to_fs(str(out))
    rows = pyarrow.dataset.dataset(f"{path}/manifest", filesystem=files).to_table().to_pylist()
    assert len({row["pair"] for row in rows}) == len(rows)
    return {row["pair"]: row for row in rows}


def read_write_times_ns(out: Path) -> dict[str, int]:
    return {path.parent.name: path.stat().st_mtime_ns for path in out.glob("*/disparity.pfm")}


def test_bad_pairs_become_rows_and_the_next_run_processes_missing_changed_and_new_pairs(engine, tmp_path):
    source, out = write_pairs(tmp_path / "pairs", number_names(8)), tmp_path / "out"
    write_image(source / "left" / "alone.png", read_image(source / "left" / "00.png"))
    bad, odd = source / "right" / "01.png", source / "right" / "02.png"
    whole = {path: path.read_bytes() for path in (bad, odd)}
    bad.write_bytes(whole[bad][:500])
    write_image(odd, read_image(odd)[:-4])
    tally = run_cluster(source, out, JOB, engine)
    assert (tally.made, tally.there, tally.failed, tally.manifest) == (6, 0, 3, str(out / "manifest"))
    rows = read_manifest(out)
    assert list(sorted(rows)) == [*number_names(8), "alone"]
    assert str(bad) in rows["01"]["error"]
    assert "of the same size, found" in rows["02"]["error"]
    assert rows["alone"]["error"].endswith(
        "alone.png: expected a picture (PNG, JPEG, TIFF or the like), found no such file"
    )
    assert dict(tally.named) == {name: rows[name]["error"] for name in ("01", "02", "alone")}

    pictures = [source / side / "03.png" for side in ("left", "right")]
    made = make_depth(pictures, tmp_path / "alone", replace(JOB, backend=Backend(threads=1)))
    for file in JOB.always:
        assert (out / "03" / file).read_bytes() == (tmp_path / "alone" / file).read_bytes()
    row = rows["03"]
    assert (row["width_px"], row["height_px"], row["error"]) == (64, 48, None)
    assert row["disparity_median_px"] == pytest.approx(made.summary.disparity_median_px)
    assert row["confident_percent"] == pytest.approx(made.summary.confident_percent)
    assert (row["pictures"], row["checks"]) == (["03.png", "03.png"], made.all_notes)

    before = read_write_times_ns(out)
    for path, content in whole.items():
        path.write_bytes(content)
    (source / "left" / "alone.png").unlink()
    write_image(source / "left" / "04.png", read_image(source / "left" / "05.png"))
    (out / "06" / "confidence.png").unlink()
    write_pairs(source, ["new"])
    tally = run_cluster(source, out, JOB, engine)
    assert (tally.made, tally.there, tally.failed) == (5, 4, 1)  # 01, 02, 04, 06, new; alone is still missing
    after = read_write_times_ns(out)
    assert {name for name in after if after[name] != before.get(name)} == {"01", "02", "04", "06", "new"}
    rows = read_manifest(out)
    assert {name for name, row in rows.items() if row["error"]} == {"alone"}
    assert set(rows) == {*number_names(8), "alone", "new"}
    assert not list((out / "begun").iterdir())


def test_a_set_whose_names_tell_no_sides_says_what_they_are_taken_for(tmp_path):
    for folder in ("image_2", "image_3"):
        (tmp_path / "kitti" / folder).mkdir(parents=True)
        (tmp_path / "kitti" / folder / "000000_10.png").touch()
    (note,) = extend_plan(store_at(tmp_path / "kitti"), store_at(tmp_path / "out"), workers=1).notes
    assert note.endswith("as 1_L.jpg and 1_R.jpg do, so each picture is taken to hold both views")


def test_no_pair_is_lost_or_duplicated_when_workers_and_the_driver_are_killed(ray_address, engine, tmp_path):
    names = number_names(40)
    source, out = write_pairs(tmp_path / "pairs", names, (256, 192)), tmp_path / "out"
    program = "import sys; from stereoweave.cli.root import main; sys.exit(main())"
    words = ["batch", str(source), str(out), "--address", ray_address, "--workers", "2"]
    driver = subprocess.Popen([sys.executable, "-c", program, *words], stderr=subprocess.DEVNULL)

    def parts() -> int:
        return len(list((out / "manifest").glob("part-*.parquet")))

    def wait_for(count: int) -> None:
        while parts() < count and driver.poll() is None:
            time.sleep(0.01)

    wait_for(2)
    workers = [process for process in list_processes(os.getpid()) if b"MapWorker" in read_command(process)]
    os.kill(workers[0], signal.SIGKILL)
    wait_for(6)
    with halted(driver):
        with pytest.raises(OutputInUseError, match=f"{out}: .* found one that is in use"):
            run_cluster(source, out, DepthJob(), engine)
        driver.kill()
    assert driver.wait() == -signal.SIGKILL
    assert 6 <= parts() < 20
    kept = read_write_times_ns(out)
    complete = set(read_manifest(out))

    job = DepthJob()
    tally = run_cluster(source, out, job, engine)
    assert (tally.made + tally.there, tally.failed) == (40, 0)
    assert tally.there >= len(complete) > 0
    rows = read_manifest(out)
    assert sorted(rows) == names
    assert not any(row["error"] for row in rows.values())
    now = read_write_times_ns(out)
    assert {name: now[name] for name in complete} == {name: kept[name] for name in complete}
    for name in names:
        assert read_pfm(out / name / "disparity.pfm").shape == (192, 256)
        assert read_image(out / name / "preview.png").shape == (192, 256, 3)


def read_command(process: int) -> bytes:
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return b""


class KilledByPair(ChunkWorker):
    """A worker whose process is killed by pair 01."""

    def make_row(self, entry):
        if entry.name == "01":
            os.kill(os.getpid(), signal.SIGKILL)
        return super().make_row(entry)


def test_a_pair_that_kills_its_process_becomes_a_row_and_affects_no_other_pair(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster_worker, "_MOST_TRIES", 2)
    source, out = store_at(write_pairs(tmp_path / "pairs", number_names(3))), store_at(tmp_path / "out")
    monkeypatch.setattr("stereoweave.batch.manifest._CHUNKS_PER_WORKER", 1)
    [first] = extend_plan(source, out, workers=1).chunks
    out.write_bytes(f"begun/{first:08d}.json", b"{}")  # left by a worker that the pair killed
    counts = KilledByPair(source, out, JOB)([first])
    assert (counts.made, counts.failed) == (2, 1)
    rows = read_rows(out, first)
    assert [row["error"] for row in rows.values()] == [
        None,
        "its process was killed on every attempt; did it run out of memory?",
        None,
    ]
    assert not out.exists(f"begun/{first:08d}.json")


def test_a_pair_whose_process_was_killed_is_tried_again_by_the_next_run(stores_and_chunk):
    source, out, chunk = stores_and_chunk
    entries, kept = read_chunk(out, chunk), {"disparity_median_px": 7.0}
    ended = ChunkWorker(source, out, JOB, run="first")
    rows = [ended.make_row(entries[0]) | kept, ended._make_empty_row(entries[1]) | {"error": "killed"}]
    mark = {"run": "first", "tries": {entries[0].name: 1, entries[1].name: 3}, "rows": rows}
    out.write_bytes(f"begun/{chunk:08d}.json", json.dumps(mark).encode())
    assert ChunkWorker(source, out, JOB, run="second")([chunk]).made == 3
    written = list(read_rows(out, chunk).values())
    assert [row["error"] for row in written] == [None] * 3
    assert written[0]["disparity_median_px"] == 7.0  # not made again


class KilledAtStart(ChunkWorker):
    """A worker whose child processes are all killed while they start."""

    @property
    def _loaded_job(self):
        os.kill(os.getpid(), signal.SIGKILL)


class OutOfMemory(ChunkWorker):
    """A worker whose provider runs out of memory on pair 01."""

    def _process_pair(self, entry, *more):
        if entry.name == "01":
            raise ProviderError("provider cpu: expected to run small.onnx, found that it failed: alloc")
        return super()._process_pair(entry, *more)


@pytest.fixture
def stores_and_chunk(tmp_path, monkeypatch):
    """Return the source and destination of a chunk of three pairs, and the chunk's number."""
    monkeypatch.setattr("stereoweave.batch.manifest._CHUNKS_PER_WORKER", 1)
    source, out = store_at(write_pairs(tmp_path / "pairs", number_names(3))), store_at(tmp_path / "out")
    [chunk] = extend_plan(source, out, workers=1).chunks
    return source, out, chunk


def test_rows_saved_by_a_killed_worker_are_kept_if_their_results_exist(stores_and_chunk):
    source, out, chunk = stores_and_chunk
    worker = ChunkWorker(source, out, JOB)
    entry = read_chunk(out, chunk)
    rows = [worker._make_empty_row(one) | {"checks": ["noted"]} for one in entry[:2]]
    rows[0]["files"] = ["disparity.pfm"]  # which does not exist
    mark = f"begun/{chunk:08d}.json"
    out.write_bytes(mark, json.dumps({"rows": rows}).encode())
    assert worker([chunk]).made == 3
    assert [row["checks"] == ["noted"] for row in read_rows(out, chunk).values()] == [False, True, False]
    out.write_bytes(mark, b"")  # emptied by a power failure
    assert worker._read_mark(mark) == {}
    out.remove(mark)  # by another run that has just finished the chunk
    assert worker._read_mark(mark) == {}


def test_the_run_fails_if_child_processes_are_killed_while_they_start(stores_and_chunk, monkeypatch):
    monkeypatch.setattr(cluster_worker, "_MOST_FALSE_STARTS", 2)
    source, out, chunk = stores_and_chunk
    out.write_bytes(f"begun/{chunk:08d}.json", b"{}")
    with pytest.raises(
        StereoweaveError, match="was killed 2 times in a row while loading the network; did it run out"
    ):
        KilledAtStart(source, out, JOB)([chunk])


def test_a_pair_too_large_for_the_provider_becomes_a_row_but_a_broken_provider_ends_the_run(
    stores_and_chunk, monkeypatch
):
    source, out, chunk = stores_and_chunk
    with monkeypatch.context() as patch:
        patch.setattr(Matcher, "estimate_many", raise_provider_error)
        with pytest.raises(ProviderError, match=r"^provider cpu: .* it failed: lost$"):
            OutOfMemory(source, out, JOB)([chunk])
    assert read_rows(out, chunk) == {}
    out.remove(f"begun/{chunk:08d}.json")
    counts = OutOfMemory(source, out, JOB)([chunk])
    assert (counts.made, counts.failed) == (2, 1)
    assert read_rows(out, chunk)["01"]["error"].endswith("found that it failed: alloc")
    counts = ChunkWorker(source, out, JOB)([chunk])
    assert (counts.made, counts.there) == (1, 2)


def raise_provider_error(*_: object, **__: object) -> None:
    raise ProviderError("provider cpu: expected to run small.onnx, found that it failed: lost")


def test_a_provider_missing_on_a_workers_machine_ends_the_run_without_a_row(stores_and_chunk):
    source, out, chunk = stores_and_chunk
    with pytest.raises(MatcherError, match="provider directml: expected an ONNX Runtime that includes it"):
        ChunkWorker(source, out, replace(JOB, backend=Backend(provider="directml")))([chunk])
    assert read_rows(out, chunk) == {}


class ModelRemover(ChunkWorker):
    """A worker whose model file is replaced by an invalid one after each pair."""

    def _process_pair(self, entry, *more):
        row = super()._process_pair(entry, *more)
        self.job.backend.model.write_bytes(b"no network")
        return row


@pytest.mark.parametrize("in_child_process", [False, True])
def test_a_model_file_replaced_during_a_batch_is_not_loaded(stores_and_chunk, tmp_path, in_child_process):
    source, out, chunk = stores_and_chunk
    model = Path(shutil.copy(model_file("small"), tmp_path / "model.onnx"))
    if in_child_process:
        out.write_bytes(f"begun/{chunk:08d}.json", b"{}")
    counts = ModelRemover(source, out, replace(JOB, backend=Backend(model=model)))([chunk])
    assert (counts.made, counts.failed) == (3, 0)


def test_the_driver_keeps_no_network(tmp_path):
    _load.cache_clear()
    with pytest.raises(StereoweaveError, match="none: expected a folder"):
        run_cluster(tmp_path / "none", tmp_path / "out", JOB)
    assert _load.cache_info().currsize == 0


def test_a_machine_that_does_not_see_a_folder_is_named(stores_and_chunk, tmp_path):
    source, out, _ = stores_and_chunk
    worker = ChunkWorker(source, out, JOB)
    assert _check_folders(worker) is worker
    for places_there in ((store_at(tmp_path / "none"), out), (source, store_at(tmp_path / "none"))):
        with pytest.raises(
            StereoweaveError, match="none: expected a folder, found no such folder; put"
        ) as caught:
            _check_folders(ChunkWorker(*places_there, JOB))
        assert str(caught.value).startswith(f"{platform.node()}: ")


GONE = StereoweaveError(
    "expected a store, found none", setting="source", remedy=Remedy("mount it", ("workers",))
)


def raise_gone(*_: object) -> None:
    raise GONE


def test_a_store_error_keeps_its_setting_and_remedy(stores_and_chunk, monkeypatch):
    source, out, chunk = stores_and_chunk
    monkeypatch.setattr(type(source), "fetch", raise_gone)
    monkeypatch.setattr(type(source), "check_source", raise_gone)
    with pytest.raises(StereoweaveError) as caught:
        ChunkWorker(source, out, JOB)([chunk])
    assert caught.value.format(str.upper) == "SOURCE: expected a store, found none; mount it (WORKERS)"
    with pytest.raises(StereoweaveError) as caught:
        _check_folders(ChunkWorker(source, out, JOB))
    assert caught.value.format(str.upper) == (
        f"SOURCE: {platform.node()}: expected a store, found none; put the folder on a disk that all "
        "machines in the cluster share, or use an object store; mount it (WORKERS)"
    )


def test_a_full_disk_error_keeps_its_setting_and_remedy(stores_and_chunk):
    source, out, _ = stores_and_chunk
    full = StereoweaveError(GONE.message, setting=GONE.setting, remedy=GONE.remedy)
    full.__cause__ = OSError(errno.ENOSPC, "full")
    with pytest.raises(StereoweaveError) as caught:
        ChunkWorker(source, out, JOB)._check_disk(full)
    assert caught.value.format(str.upper) == (
        f"SOURCE: {out.place}: expected a store, found none; mount it (WORKERS)"
    )
    with pytest.raises(StereoweaveError, match=f"^{out.place}: .Errno {errno.ENOSPC}. full$"):
        ChunkWorker(source, out, JOB)._check_disk(OSError(errno.ENOSPC, "full"))


def test_a_video_is_processed_after_parts_of_another_video_are_removed(tmp_path):
    (tmp_path / "films").mkdir()
    write_side_by_side(tmp_path / "films" / "sea.mkv", example_pairs(3))
    source, out = store_at(tmp_path / "films"), store_at(tmp_path / "out")
    parts = parts_folder(tmp_path / "out" / "sea.mkv" / FILM)
    parts.mkdir(parents=True)
    (parts / "000001.nut").touch()
    np.savez(parts / "state-000001.npz")
    (parts / "settings.json").write_text("{}")
    [chunk] = extend_plan(source, out, workers=1).chunks
    assert ChunkWorker(source, out, JOB)([chunk]).made == 1
    [row] = read_rows(out, chunk).values()
    assert (row["files"], row["error"], row["width_px"]) == ([FILM], None, 160)
    assert len(packets(tmp_path / "out" / "sea.mkv" / FILM, "video")) == 3
    assert not parts.exists()


def test_a_video_is_processed_by_the_projection_that_is_given(tmp_path):
    (tmp_path / "films").mkdir()
    write_side_by_side(tmp_path / "films" / "sea.mkv", example_pairs(2))
    source, out = store_at(tmp_path / "films"), store_at(tmp_path / "out")
    [chunk] = extend_plan(source, out, workers=1).chunks
    sphere = SphereRequest(projection="half_equirectangular", fov_deg=60.0)
    job = replace(JOB, request=Request(format="side_by_side", sphere=sphere))
    assert ChunkWorker(source, out, job)([chunk]).made == 1
    [row] = read_rows(out, chunk).values()
    # 160 px over 180 degrees are 50.9 px a radian; of 60 degrees, 2 * 50.9 * tan(30 degrees) = 58.8.
    assert (row["files"], row["error"], row["width_px"]) == ([FILM], None, 58)


def checks_of_video(folder: Path, job: DepthJob) -> list[str]:
    """Return the checks in the row of a video whose sides are swapped if it is read as `side_by_side`."""
    (folder / "films").mkdir()
    write_side_by_side(folder / "films" / "sea.mkv", example_pairs(3), layout="crossed")
    source, out = store_at(folder / "films"), store_at(folder / "out")
    [chunk] = extend_plan(source, out, workers=1).chunks
    assert ChunkWorker(source, out, job)([chunk]).made == 1
    [row] = read_rows(out, chunk).values()
    return row["checks"]


@pytest.mark.parametrize(
    ("rectify", "told"),
    [(None, "left and right were swapped"), (False, "left and right are swapped; choose crossed (format)")],
)
def test_a_video_is_rectified_unless_refused_and_the_row_has_its_notes(tmp_path, rectify, told):
    job = replace(JOB, request=Request(format="side_by_side", rectify=rectify))
    assert told in " ".join(checks_of_video(tmp_path, job))


def test_a_video_has_the_camera_of_the_calibration(tmp_path):
    calibration = tmp_path / "calib.txt"
    cameras = ["cam0=[300 0 80; 0 300 48; 0 0 1]", "cam1=[300 0 80; 0 300 48; 0 0 1]"]
    calibration.write_text("\n".join([*cameras, "doffs=0", "baseline=100", "width=160", "height=96"]))
    job = replace(JOB, request=Request(format="crossed", calibration=calibration))
    assert "is a calibration of rectified pictures" in " ".join(checks_of_video(tmp_path, job))
    with av.open(str(tmp_path / "out" / "sea.mkv" / FILM)) as film:
        assert film.metadata["COMMENT"].endswith("depth in metres = 7680 / value")  # 300 * 0.1 * 256


def test_a_calibration_for_other_pictures_is_named_and_not_used_for_a_video(tmp_path):
    calibration = tmp_path / "calib.txt"
    cameras = ["cam0=[300 0 80; 0 300 48; 0 0 1]", "cam1=[300 0 80; 0 300 48; 0 0 1]"]
    calibration.write_text("\n".join([*cameras, "doffs=0", "baseline=100", "width=640", "height=480"]))
    job = replace(JOB, request=Request(format="crossed", calibration=calibration))
    told = "some settings were not used for this video; they apply to pairs only (calibration)"
    assert told in checks_of_video(tmp_path, job)


def test_the_row_of_a_video_names_the_settings_that_apply_to_pairs_only(tmp_path):
    request = Request(format="crossed", focal_px=700.0, baseline_m=0.1)
    job = DepthJob(request=request, options=MatchOptions(raw=True, range_px=(0, 64)), files=("depth.png",))
    told = "some settings were not used for this video; they apply to pairs only"
    names = "(focal_px, baseline_m, range_px, raw, files)"
    assert f"{told} {names}" in checks_of_video(tmp_path, job)


def test_a_spatial_video_is_processed(tmp_path):
    (tmp_path / "films").mkdir()
    shutil.copy(SPATIAL, tmp_path / "films")
    source, out = store_at(tmp_path / "films"), store_at(tmp_path / "out")
    [chunk] = extend_plan(source, out, workers=1).chunks
    assert ChunkWorker(source, out, JOB)([chunk]).made == 1
    [row] = read_rows(out, chunk).values()
    assert (row["files"], row["error"], row["width_px"]) == ([FILM], None, 320)
    assert len(packets(tmp_path / "out" / SPATIAL.name / FILM, "video")) == 50


def test_a_video_in_use_by_another_process_becomes_an_error_row_and_keeps_its_parts(tmp_path):
    (tmp_path / "films").mkdir()
    write_side_by_side(tmp_path / "films" / "sea.mkv", example_pairs(3))
    source, out = store_at(tmp_path / "films"), store_at(tmp_path / "out")
    film = tmp_path / "out" / "sea.mkv" / FILM
    parts_folder(film).mkdir(parents=True)
    (parts_folder(film) / "000001.nut").touch()
    [chunk] = extend_plan(source, out, workers=1).chunks
    with lock_output(film):
        assert ChunkWorker(source, out, JOB)([chunk]).failed == 1
    [row] = read_rows(out, chunk).values()
    assert "found one that is in use" in row["error"]
    assert [path.name for path in parts_folder(film).iterdir()] == ["000001.nut"]


def test_old_temporary_files_of_killed_workers_are_removed(tmp_path):
    for age_s in (0, 3600):
        for name in (f".stereoweave-{age_s:08d}", f".part-{age_s:08d}.parquet", f".mine-{age_s}"):
            path = tmp_path / name
            path.mkdir() if "weave" in name else path.touch()
            os.utime(path, (time.time() - age_s,) * 2)
    remove_abandoned(tmp_path)
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {".stereoweave-00000000", ".part-00000000.parquet", ".mine-0", ".mine-3600"}


def test_a_local_file_named_like_a_shipped_network_is_not_sent_to_workers(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("small").write_bytes(b"something else")
    assert list(_read_job_files(DepthJob())) == []


def test_a_name_that_is_not_utf8_is_refused(tmp_path):
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        Path(os.fsdecode(os.fsencode(tmp_path / side) + b"/\xff.png")).touch()
    with pytest.raises(StereoweaveError, match=r"names in UTF-8, found '.*\\udcff.*'; rename the file"):
        extend_plan(store_at(tmp_path), store_at(tmp_path / "out"), workers=1)


def test_another_runs_destination_and_an_empty_source_are_refused(engine, tmp_path):
    source, out = write_pairs(tmp_path / "pairs", ["00"]), tmp_path / "out"
    assert run_cluster(source, out, JOB, engine).made == 1
    with pytest.raises(StereoweaveError, match=r"batch.json: expected always = .*, found .* another folder"):
        run_cluster(source, out, DepthJob(), engine)
    other = write_pairs(tmp_path / "other", ["00"])
    with pytest.raises(StereoweaveError, match=r"batch.json: expected source = .*other.*, found .*pairs"):
        run_cluster(other, out, JOB, engine)
    with pytest.raises(StereoweaveError, match=r"other: expected an empty folder or one with a batch.json"):
        run_cluster(source, other, JOB, engine)
    with pytest.raises(StereoweaveError, match="none: expected a folder, found no such folder"):
        run_cluster(tmp_path / "none", tmp_path / "new", JOB, engine)
    (tmp_path / "empty").mkdir()
    with pytest.raises(StereoweaveError, match="expected videos or pairs of pictures, found none"):
        run_cluster(tmp_path / "empty", tmp_path / "new", JOB, engine)


def test_a_batch_runs_from_bucket_to_bucket_and_names_a_bad_pair_by_its_url(engine, bucket, tmp_path):
    local = write_pairs(tmp_path / "pairs", number_names(3))
    (local / "right" / "02.png").write_bytes(b"none")
    store = store_at(f"{bucket}/in")
    for path in local.rglob("*.png"):
        store.put(path, path.relative_to(local).as_posix())
    for name in ("left.png", "right.png", "calib.txt"):
        store.put(TEXTURED / name, f"room/{name}")
    tally = run_cluster(f"{bucket}/in", f"{bucket}/out", JOB, engine)
    assert (tally.made, tally.failed, tally.manifest) == (3, 1, f"{bucket}/out/manifest")
    rows = read_manifest(f"{bucket}/out")
    assert rows["02"]["error"].startswith(f"{bucket}/in/right/02.png: expected a picture")
    assert "depth.png" in rows["room"]["files"]
    out = store_at(f"{bucket}/out")
    pictures = [local / side / "00.png" for side in ("left", "right")]
    make_depth(pictures, tmp_path / "alone", replace(JOB, backend=Backend(threads=1)))
    for file in JOB.always:
        assert out.read_bytes(f"00/{file}") == (tmp_path / "alone" / file).read_bytes()
    tally = run_cluster(f"{bucket}/in", f"{bucket}/out", JOB, engine)
    assert (tally.made, tally.there, tally.failed) == (0, 3, 1)
    with pytest.raises(StereoweaveError, match="expected a bucket, found none named nobodys"):
        run_cluster("s3://nobodys/in", f"{bucket}/new", JOB, engine)


def test_the_command_prints_counts_failures_and_the_manifest(engine, tmp_path, capsys):
    source, out = write_pairs(tmp_path / "pairs", number_names(2)), tmp_path / "out"
    (source / "left" / "01.png").write_bytes(b"none")
    assert main(["batch", str(source), str(out), "--workers", "1"]) == 1
    printed = capsys.readouterr()
    assert printed.out.splitlines()[0] == f"{out}: 2 pairs: 1 made, 1 failed"
    assert printed.out.splitlines()[1].startswith(f"failed: 01: {source}/left/01.png: expected a picture")
    assert printed.out.splitlines()[2] == f"manifest: {out / 'manifest'}"
    assert main(["batch", str(source), str(out), "--json"]) == 1
    facts = json.loads(capsys.readouterr().out)
    assert (facts["made"], facts["there"], facts["failed"], list(facts["named"])) == (0, 1, 1, ["01"])
