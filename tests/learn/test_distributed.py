import time

import pytest
from learn_examples import complaint

from stereoweave.errors import StereoweaveError
from stereoweave.learn import distributed
from stereoweave.learn.distributed import ProcessRank, choose_thread_count, read_rank, report_once


@pytest.fixture
def started(monkeypatch):
    """Return a function that sets the environment of a process that torchrun started."""

    def start(rank, count, here):
        monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
        for name, value in (("RANK", rank), ("WORLD_SIZE", count), ("LOCAL_WORLD_SIZE", here)):
            monkeypatch.setenv(name, str(value))

    return start


def fail():
    with report_once():
        raise StereoweaveError("this and that")


def test_a_process_that_torchrun_did_not_start_is_alone(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "8")
    assert read_rank() == ProcessRank(0, 1, 1)
    assert list(read_rank().own_micro_batches(3)) == [0, 1, 2]


def test_a_process_that_torchrun_started_reads_its_rank(started):
    started(5, 8, 4)
    assert read_rank() == ProcessRank(5, 8, 4)
    assert list(read_rank().own_micro_batches(16)) == [10, 11]


def test_rank_0_raises_an_error_at_once_and_the_others_wait_to_be_ended(started, monkeypatch):
    waited = []
    monkeypatch.setattr(time, "sleep", waited.append)
    for rank in (0, 1, 2):
        started(rank, 3, 3)
        assert complaint(fail) == "this and that"
    assert waited == [20, 20]


def test_a_rank_that_loses_its_connection_to_another_one_also_waits(started, monkeypatch):
    waited = []
    monkeypatch.setattr(time, "sleep", waited.append)
    for rank, count in ((0, 1), (0, 2), (1, 2)):
        started(rank, count, count)
        with pytest.raises(RuntimeError, match="closed by peer"), report_once():
            raise RuntimeError("connection closed by peer")
    assert waited == [20, 20]


def test_processes_of_a_machine_share_its_cores_unless_the_user_sets_the_threads(started, monkeypatch):
    monkeypatch.setattr(distributed, "usable_cores", lambda: 12)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    assert choose_thread_count() is None
    started(1, 8, 5)
    assert choose_thread_count() == 2
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert choose_thread_count() is None


def test_the_single_thread_that_torchrun_sets_does_not_count_as_the_users_choice(started, monkeypatch):
    monkeypatch.setattr(distributed, "usable_cores", lambda: 12)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert choose_thread_count() is None
    started(1, 8, 5)
    assert choose_thread_count() == 2
