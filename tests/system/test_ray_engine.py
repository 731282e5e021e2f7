"""The engine on a real Ray: results, killed workers, errors, and wrong addresses."""

import importlib
import os
import signal
import socket
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
import ray
from ray.data import DataContext

from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.system import ray_engine as engine_module
from stereoweave.system.ray_engine import Engine, call_on_each_machine, connect, count_slots, stream

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def engine(ray_address):
    engine = Engine(ray_address, workers=2)
    with connect(engine):
        yield engine


def make_reporter():
    import cv2

    made_in = os.getpid()
    return lambda task: (task, made_in, os.getpid(), cv2.getNumThreads(), os.environ["OMP_NUM_THREADS"])


def make_mortal(folder: Path):
    """Return a worker that is killed by the first attempt at each task whose number is divisible by 5."""

    def work(task: int) -> int:
        (folder / f"{task} by {os.getpid()}").touch()
        if task % 5 == 0 and len(list(folder.glob(f"{task} by *"))) == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return -task

    return work


def make_slow(seconds: float):
    def work(task: int) -> int:
        time.sleep(seconds)
        return task

    return work


def make_failing(error: Exception):
    def work(task: int) -> int:
        if task == 3:
            raise error
        return task

    return work


def test_each_task_gives_one_result_from_workers_that_are_made_once_and_use_one_core(engine):
    results = list(stream(make_reporter, range(40), engine))
    assert sorted(result[0] for result in results) == list(range(40))
    assert {result[1:3] for result in results} == {(pid, pid) for _, pid, *_ in results}
    assert 1 <= len({pid for _, pid, *_ in results}) <= 2
    assert {result[3:] for result in results} == {(1, "1")}
    assert list(stream(make_reporter, [], engine)) == []


def test_the_tasks_of_a_killed_worker_are_repeated_by_its_successor(engine, tmp_path):
    results = sorted(stream(partial(make_mortal, tmp_path), range(12), engine))
    assert results == sorted(-task for task in range(12))
    assert len(list(tmp_path.glob("10 by *"))) == 2


def test_a_task_may_take_longer_than_ray_data_waits_for_progress(engine, monkeypatch):
    context = DataContext.get_current()
    monkeypatch.setattr(context, "execution_no_progress_timeout_s", 1)
    assert list(stream(partial(make_slow, 3), [1], engine)) == [1]


def test_a_workers_error_is_raised_unchanged_in_the_driver(engine):
    with pytest.raises(FormatError, match=r"^invalid file$"):
        list(stream(partial(make_failing, FormatError("invalid file")), range(8), engine))
    with pytest.raises(KeyError) as caught:
        list(stream(partial(make_failing, KeyError("mistake")), range(8), engine))
    assert "in work" in caught.value.__notes__[0]


def test_workers_that_lack_a_module_are_reported_in_one_line(engine, tmp_path, monkeypatch, capfd):
    (tmp_path / "only_here.py").write_text("def make():\n    return str\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(engine_module, "_MOST_FALSE_STARTS", 0)
    make = importlib.import_module("only_here").make
    with pytest.raises(StereoweaveError, match="workers failed: .*No module named 'only_here'; ") as caught:
        list(stream(make, [1], engine))
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().out == ""


def test_a_killed_worker_causes_no_output(ray_address, tmp_path):
    program = """
import os, sys, time
from pathlib import Path
from stereoweave.system.ray_engine import Engine, stream

folder = Path(sys.argv[2])

def make():
    def work(task):
        if len(list(folder.iterdir())) < 3:
            (folder / str(os.getpid())).touch()
            os.kill(os.getpid(), 9)
        return task
    return work

for result in stream(make, range(3), Engine(sys.argv[1], workers=1)):
    print(result)
time.sleep(3)  # until Ray has reported
"""
    command = [sys.executable, "-c", program, ray_address, str(tmp_path)]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_DEDUP")}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert len(list(tmp_path.iterdir())) == 3
    assert sorted(done.stdout.split()) == ["0", "1", "2"]
    assert done.stderr == ""


def test_a_worker_too_large_for_every_machine_is_refused_and_fractions_of_cores_are_counted(engine):
    assert count_slots(engine) == 2
    assert count_slots(Engine(cpus_each=0.1)) == 20
    with pytest.raises(StereoweaveError, match=r"a machine with 3 cores and 0 GPUs .* found 2 and 0"):
        list(stream(make_reporter, [1], Engine(cpus_each=3)))
    with pytest.raises(
        StereoweaveError,
        match=r"a machine with 1 core and 0.5 GPUs .* found 2 and 0 .*; or use lower values "
        r"\(cpus_each, gpus_each\)$",
    ):
        count_slots(Engine(gpus_each=0.5))
    nan, inf = float("nan"), float("inf")
    shares = ({"cpus_each": cpus} for cpus in (0, 1e-5, nan, inf))
    gpus = ({"gpus_each": gpus} for gpus in (-1, 1e-5, 1.5, nan, inf))
    for wrong in ({"workers": 0}, *shares, *gpus):
        with pytest.raises(StereoweaveError, match="expected"):
            Engine(**wrong)


def name_of_positive(task: int) -> str:
    if task < 0:
        raise ValueError("negative")
    return f"{task} in {os.getpid()}"


def test_a_function_is_called_on_each_machine_with_room_and_errors_are_left_out(engine):
    (result,) = call_on_each_machine(name_of_positive, 7, Engine(), timeout_s=60)
    assert result.startswith("7 in ")
    assert result != name_of_positive(7)
    assert call_on_each_machine(name_of_positive, -7, Engine(), timeout_s=60) == []
    assert call_on_each_machine(name_of_positive, 7, Engine(cpus_each=3), timeout_s=60) == []
    assert call_on_each_machine(name_of_positive, 7, Engine(), timeout_s=0) == []


def test_a_program_keeps_its_own_handler_of_sigterm(ray_address):
    program = (
        "import signal, sys; from stereoweave.system.ray_engine import Engine, connect\n"
        "def stop(number, frame): print('stopped', number); sys.exit(7)\n"
        "signal.signal(signal.SIGTERM, stop)\n"
        "with connect(Engine(sys.argv[1])): signal.raise_signal(signal.SIGTERM)"
    )
    ended = subprocess.run([sys.executable, "-c", program, ray_address], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout) == (7, f"stopped {signal.SIGTERM:d}\n"), ended.stderr


def test_a_wrong_address_is_reported_in_one_line(engine, monkeypatch):
    ray.shutdown()  # with an existing connection, the address would not be used
    monkeypatch.setattr(engine_module, "_STATUS_TIMEOUT_S", 1)
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        no_reply = r"expected the head of a Ray cluster, found none \(no reply in 1 s\)"
        addresses = {
            "127.0.0.1:1": "^127.0.0.1:1: expected the head of a Ray cluster, found .*refused",
            "ray://127.0.0.1:1": "expected the head of a Ray cluster, found .*refused",
            f"127.0.0.1:{deaf.getsockname()[1]}": no_reply,
            "nonsense": "expected host:port, ray://host:port, auto or local, found 'nonsense'",
        }
        for address, expected in addresses.items():
            with pytest.raises(StereoweaveError, match=expected) as caught, connect(Engine(address)):
                pass
            assert "\n" not in str(caught.value)


def test_the_token_is_sent_to_a_head_that_requires_it_and_a_wrong_token_is_reported_in_one_line(
    guarded_ray_address,
):
    program = """
import sys
from stereoweave.errors import StereoweaveError
from stereoweave.system.ray_engine import Engine, connect, count_slots

engine = Engine(sys.argv[1])
try:
    with connect(engine):
        print(count_slots(engine), "worker")
except StereoweaveError as error:
    print(error)
"""
    printed = {}
    for letter in "ab":
        command = [sys.executable, "-c", program, guarded_ray_address]
        environment = {**os.environ, "RAY_AUTH_TOKEN": 64 * letter}
        environment.pop("RAY_AUTH_MODE", None)
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
        assert done.stderr == ""
        printed[letter] = done.stdout
    assert printed["a"] == "1 worker\n"
    assert printed["b"].count("\n") == 1
    assert printed["b"].startswith(f"{guarded_ray_address}: expected the head of a Ray cluster, found ")
    assert "token is missing or incorrect" in printed["b"]
