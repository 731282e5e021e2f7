import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path

import psutil
import pytest

from stereoweave.errors import FormatError, MatcherError
from stereoweave.matching.backend import Backend
from stereoweave.service import replica_processes
from stereoweave.service.answers import BatchAnswerer, ServiceAnswer, ServiceJob, load_answerer
from stereoweave.service.replica_processes import ReplicaProcesses, TimedJob
from stereoweave.system.child_process import NotStartedError

pytestmark = pytest.mark.system

TEXTURED = Path(__file__).parents[1] / "textured_pair"
PICTURES = (TEXTURED / "left.png", TEXTURED / "right.png")


def make_job(file: str = "disparity.png", within_s: float = 60) -> TimedJob:
    job = ServiceJob(folder=TEXTURED, pictures=PICTURES, file=file)
    return TimedJob(job, megapixels=0.6, deadline_s=time.monotonic() + within_s)


def load_named_answerer() -> BatchAnswerer:
    """Return a stand-in for a network: the jobs "sleep" and "crash" do so, others get their name."""

    def answer(jobs: Sequence[ServiceJob]) -> list[ServiceAnswer | Exception]:
        for job in jobs:
            if job.file == "sleep":
                time.sleep(60)
            if job.file == "crash":
                signal.raise_signal(signal.SIGSEGV)
        return [ServiceAnswer(content=job.file.encode(), report="{}") for job in jobs]

    return answer


@pytest.fixture(scope="module")
def processes(tmp_path_factory) -> Iterator[ReplicaProcesses]:
    processes = ReplicaProcesses(load_named_answerer, tmp_path_factory.mktemp("files"))
    processes.answer([make_job()])  # wait for the start, which would take time from the tests' jobs
    yield processes
    processes.close()


def list_names(outcomes: Sequence[ServiceAnswer | Exception]) -> list[str]:
    return [
        outcome.content.decode() if isinstance(outcome, ServiceAnswer) else type(outcome).__name__
        for outcome in outcomes
    ]


def test_a_job_that_misses_its_deadline_is_ended_and_the_others_are_answered(processes):
    start_s = time.monotonic()
    outcomes = processes.answer([make_job("first"), make_job("sleep", within_s=0.3), make_job("second")])
    assert list_names(outcomes) == ["first", "TimeoutError", "second"]
    assert time.monotonic() - start_s < 20
    assert str(outcomes[1]).startswith("expected a result within")


def load_late() -> BatchAnswerer:
    time.sleep(60)
    return load_named_answerer()


def test_no_job_of_a_batch_is_retried_while_the_process_is_starting(tmp_path):
    processes = ReplicaProcesses(load_late, tmp_path / "files")
    start_s = time.monotonic()
    outcomes = processes.answer([make_job("first", within_s=10), make_job("second", within_s=10)])
    assert list_names(outcomes) == ["NotStartedError", "NotStartedError"]
    assert 4.9 < time.monotonic() - start_s < 8  # two retries would take 2.5 s and 1.25 s more
    processes.close()


def test_a_job_without_time_is_late_even_if_its_process_is_starting(tmp_path):
    processes = ReplicaProcesses(load_named_answerer, tmp_path / "files")
    assert list_names(processes.answer([make_job(within_s=-1)])) == ["TimeoutError"]
    processes.close()


def test_a_crash_is_reported_in_one_line_and_the_other_jobs_are_answered(processes):
    outcomes = processes.answer([make_job("first"), make_job("crash"), make_job("second")])
    assert list_names(outcomes) == ["first", "ProcessDiedError", "second"]
    assert "SIGSEGV" in str(outcomes[1])


def test_no_job_is_blamed_for_processes_that_ended_while_they_were_idle(tmp_path):
    others = set(psutil.Process().children())
    processes = ReplicaProcesses(load_named_answerer, tmp_path / "files")
    processes.answer([make_job()])
    for child in set(psutil.Process().children()) - others:
        child.kill()
        child.wait(10)
    assert processes.starting
    assert processes.measure(make_job().job, left_s=60) > 0
    assert list_names(processes.answer([make_job("first")])) == ["first"]
    processes.close()


def load_from(file: Path) -> BatchAnswerer:
    file.stat()
    return load_named_answerer()


def test_a_network_that_could_not_be_loaded_is_loaded_for_a_later_job(tmp_path):
    processes = ReplicaProcesses(partial(load_from, tmp_path / "late"), tmp_path / "files")
    with pytest.raises(FileNotFoundError):
        processes.answer([make_job("first")])
    (tmp_path / "late").touch()
    assert list_names(processes.answer([make_job("second")])) == ["second"]
    processes.close()


def test_a_job_past_its_deadline_is_not_started(processes):
    assert list_names(processes.answer([make_job("first", within_s=-1)])) == ["TimeoutError"]
    assert list_names(processes.answer([make_job("second")])) == ["second"]


def test_matching_is_ended_at_its_deadline_and_the_next_job_is_answered(tmp_path):
    processes = ReplicaProcesses(partial(load_answerer, Backend(threads=1)), tmp_path / "files")
    assert 0 < processes.warm_up() < 60
    assert list_names(processes.answer([make_job(within_s=0.01)])) == ["TimeoutError"]
    (answer,) = processes.answer([make_job()])
    assert answer.content.startswith(b"\x89PNG")
    processes.close()


def test_pictures_are_measured_from_their_headers(processes, tmp_path):
    job = make_job().job
    assert processes.measure(job, left_s=10) == pytest.approx(2 * 640 * 480 / 1e6)
    (tmp_path / "text").write_text("no picture")
    with pytest.raises(FormatError, match="expected a picture"):
        processes.measure(
            ServiceJob(folder=tmp_path, pictures=(tmp_path / "text",), file="disparity.png"), left_s=10
        )


def test_a_picture_whose_header_cannot_be_read_in_time_is_refused(processes):
    with pytest.raises(TimeoutError):
        processes.measure(make_job().job, left_s=0)


def test_a_picture_that_cannot_be_measured_in_time_is_blamed(processes, monkeypatch):
    processes.measure(make_job().job, left_s=60)  # wait for the start
    monkeypatch.setattr(replica_processes, "_MEASURING_LIMIT_S", 0.3)
    children = psutil.Process().children()
    for child in children:
        child.suspend()
    with pytest.raises(FormatError, match="could not be read within 0.3 s; save the pictures again"):
        processes.measure(make_job().job, left_s=60)
    for child in children:
        with suppress(psutil.NoSuchProcess):  # the one that measured was replaced
            child.resume()


def test_a_picture_is_not_blamed_for_a_process_that_is_still_starting(tmp_path):
    processes = ReplicaProcesses(load_named_answerer, tmp_path / "files")
    with pytest.raises(NotStartedError, match="is still starting; try again later"):
        processes.measure(make_job().job, left_s=0.01)
    processes.close()


def test_the_time_of_a_start_is_not_part_of_the_limit_for_measuring(tmp_path, monkeypatch):
    monkeypatch.setattr(replica_processes, "_MEASURING_LIMIT_S", 2)
    others = set(psutil.Process().children())
    processes = ReplicaProcesses(load_named_answerer, tmp_path / "files")
    children = set(psutil.Process().children()) - others
    for child in children:
        child.suspend()
    with ThreadPoolExecutor(1) as pool:
        measured = pool.submit(processes.measure, make_job().job, left_s=60)
        time.sleep(3)
        for child in children:
            child.resume()
        assert measured.result() == pytest.approx(2 * 640 * 480 / 1e6)
    processes.close()


LOADED = """
from stereoweave.matching import occlusion_fill_kernels, refine_kernels, subpixel_kernels, upsample_kernels
from stereoweave.matching.backend import Backend
from stereoweave.service.answers import load_answerer
load_answerer(Backend(model="small"))
first = subpixel_kernels.compare, occlusion_fill_kernels.fill_rows
print(*(kernel.loads for kernel in (refine_kernels.match, upsample_kernels.match, *first)))
"""


def test_a_process_has_loaded_its_kernels_before_its_first_job():
    for _ in range(2):  # the first process may have compiled them instead
        done = subprocess.run([sys.executable, "-c", LOADED], capture_output=True, text=True, check=True)
    assert done.stdout == "1 1 1 1\n"


def test_a_network_that_cannot_be_loaded_is_reported_before_any_job(tmp_path):
    processes = ReplicaProcesses(partial(load_answerer, Backend(model="none.onnx")), tmp_path / "files")
    with pytest.raises(MatcherError, match=r"none\.onnx: expected an ONNX matcher file"):
        processes.warm_up()
    processes.close()
