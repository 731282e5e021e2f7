import signal
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import pytest
from stereoweave.service.worker import Task, Worker

from stereoweave.errors import FormatError, MatcherError
from stereoweave.matching.backend import Backend
from stereoweave.service.answers import Answer, Answering, ServiceJob, make_answering

pytestmark = pytest.mark.system

EXAMPLES = Path(__file__).parents[2] / "examples"
PICTURES = (EXAMPLES / "left.png", EXAMPLES / "right.png")


def task(file: str = "disparity.png", within_s: float = 60) -> Task:
    job = ServiceJob(folder=EXAMPLES, pictures=PICTURES, file=file)
    return Task(job, megapixels=0.6, deadline_s=time.monotonic() + within_s)


def answering_by_name() -> Answering:
    """Instead of a network: jobs named so sleep or crash, others get their name."""

    def answer(jobs: Sequence[ServiceJob]) -> list[Answer | Exception]:
        for job in jobs:
            if job.file == "sleep":
                time.sleep(60)
            if job.file == "crash":
                signal.raise_signal(signal.SIGSEGV)
        return [Answer(content=job.file.encode(), report="{}") for job in jobs]

    return answer


@pytest.fixture(scope="module")
def worker(tmp_path_factory) -> Iterator[Worker]:
    worker = Worker(answering_by_name, tmp_path_factory.mktemp("files"))
    worker.answer([task()])  # it has started: what comes now takes its own time alone
    yield worker
    worker.close()


def names(outcomes: Sequence[Answer | Exception]) -> list[str]:
    return [
        outcome.content.decode() if isinstance(outcome, Answer) else type(outcome).__name__
        for outcome in outcomes
    ]


def test_what_overruns_is_ended_and_what_waited_with_it_is_answered(worker):
    start_s = time.monotonic()
    outcomes = worker.answer([task("first"), task("sleep", within_s=0.3), task("second")])
    assert names(outcomes) == ["first", "TimeoutError", "second"]
    assert time.monotonic() - start_s < 20
    assert str(outcomes[1]).startswith("expected to be done within")


def test_what_crashes_is_one_line_and_what_waited_with_it_is_answered(worker):
    outcomes = worker.answer([task("first"), task("crash"), task("second")])
    assert names(outcomes) == ["first", "ProcessDiedError", "second"]
    assert "SIGSEGV" in str(outcomes[1])


def test_what_is_late_already_is_not_begun(worker):
    assert names(worker.answer([task("first", within_s=-1)])) == ["TimeoutError"]
    assert names(worker.answer([task("second")])) == ["second"]


def test_a_match_by_a_network_is_ended_at_its_deadline_and_the_next_one_is_answered(tmp_path):
    worker = Worker(partial(make_answering, Backend(threads=1)), tmp_path / "files")
    assert 0 < worker.warm_up() < 60
    assert names(worker.answer([task(within_s=0.01)])) == ["TimeoutError"]
    (answer,) = worker.answer([task()])
    assert answer.content.startswith(b"\x89PNG")
    worker.close()


def test_pictures_are_measured_by_their_heads(worker, tmp_path):
    job = task().job
    assert worker.measure(job, left_s=10) == pytest.approx(2 * 640 * 480 / 1e6)
    (tmp_path / "text").write_text("no picture")
    with pytest.raises(FormatError, match="expected a picture"):
        worker.measure(
            ServiceJob(folder=tmp_path, pictures=(tmp_path / "text",), file="disparity.png"), left_s=10
        )


def test_a_picture_whose_head_cannot_be_read_in_time_is_refused(worker):
    with pytest.raises(TimeoutError):
        worker.measure(task().job, left_s=0)


def test_a_network_that_cannot_be_loaded_is_said_before_any_order(tmp_path):
    worker = Worker(partial(make_answering, Backend(model="none.onnx")), tmp_path / "files")
    with pytest.raises(MatcherError, match=r"none\.onnx: expected an ONNX matcher file"):
        worker.warm_up()
    worker.close()
