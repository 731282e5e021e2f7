"""Work on many machines, or on the cores of one: tasks stream through a pool of workers, by Ray Data."""

import logging
import math
import os
import pickle
import socket
import subprocess
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import distribution
from typing import TYPE_CHECKING, Any, TypeVar

from stereoweave.errors import StereoweaveError, needing_extra
from stereoweave.system.threads import usable_cores

if TYPE_CHECKING:
    from ray.data import DataContext, Dataset

Task = TypeVar("Task")
Result = TypeVar("Result")

_CONNECTS_WITHIN_S, _ANSWERS_WITHIN_S = 10, 20
# Tasks and results alone pass through it.
_OBJECT_STORE_BYTES = 200_000_000
_LOOKED_AT_EVERY_S, _BACK_WITHIN_S = 2, 10
# Ray counts cores and GPUs in such parts.
_LEAST_SHARE = 0.0001
# Workers that end while they start, one after another: more are no accident.
_MOST_FALSE_STARTS = 20
_SILENCE = {
    # No warning of what Ray will change, no errors of its C++ parts: those that matter are raised too.
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_BACKEND_LOG_LEVEL": "fatal",
    # No line of the cluster's logs, such as one for each killed worker, on the standard output among ours.
    "RAY_DEDUP_LOGS_SKIP_REGEX": ".*",
}
# Where this is 0, as by default on macOS and Windows, a Ray that is started here takes the loopback address
# for that of its machine, and listens there alone. If `ray.init` is given a loopback address, it replaces it.
_OPEN_TO_OTHER_MACHINES = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
_INDEX, _CONTENT = "index", "content"


@dataclass(frozen=True)
class Engine:
    """Where the work is done, and by how many.

    Attributes:
        address: A cluster's head as host:port, ray://host:port, or "auto", the one that runs here. "local"
            starts Ray on this machine for as long as the work takes; None joins the one that RAY_ADDRESS
            names, and starts one only where it names none.
        workers: At most so many at a time; as many as find room unless given.
        cpus_each: The cores that each has to itself; a part of one is allowed.
        gpus_each: The GPUs, likewise: with 0.25 four workers share one.
    """

    address: str | None = None
    workers: int | None = None
    cpus_each: float = 1
    gpus_each: float = 0

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise StereoweaveError(f"--workers: expected 1 or more, found {self.workers}")
        if not _LEAST_SHARE <= self.cpus_each < math.inf:
            raise StereoweaveError(f"--cpus-each: expected {_LEAST_SHARE} or more, found {self.cpus_each}")
        gpus = self.gpus_each
        if gpus and not (_LEAST_SHARE <= gpus < 1 or (1 <= gpus < math.inf and gpus % 1 == 0)):
            raise StereoweaveError(f"--gpus-each: expected 0, a part of 1 or a whole number, found {gpus}")

    @property
    def threads_each(self) -> int:
        """The threads that a worker may use."""
        return max(1, int(self.cpus_each))


def set_environment(address: str | None) -> str | None:
    """The address of the cluster to join; None where Ray is started here, to listen on loopback alone.

    Sets the variables that Ray reads when it is imported, except those that the user has set.
    """
    for name, value in _SILENCE.items():
        os.environ.setdefault(name, value)
    address = address or os.environ.get("RAY_ADDRESS")
    if address and address != "local":
        return address
    os.environ.setdefault(_OPEN_TO_OTHER_MACHINES, "0")
    return None


@contextmanager
def connect(engine: Engine) -> Iterator[None]:
    """Within the block this process is Ray's driver; nothing is done where it is one already.

    Raises:
        StereoweaveError: Ray is missing, or nothing at the address answers as its head.
    """
    address = set_environment(engine.address)
    with needing_extra("cluster", "this needs Ray"):
        already = "ray" in sys.modules and sys.modules["ray"].is_initialized()
        if address and not already:
            distribution("ray")  # raises ModuleNotFoundError, without the import
            _check_head(address)  # before the import, which reads whether to show a token
        import ray
    if already:
        yield
        return
    _join(address) if address else _start()
    try:
        yield
    finally:
        ray.shutdown()


def stream(
    make_worker: Callable[[], Callable[[Task], Result]], tasks: Sequence[Task], engine: Engine
) -> Generator[Result, None, None]:
    """What each task's result is, as they come, in no order.

    A task whose worker or machine dies is done again, so it may be done twice, though its result comes once.
    Where a machine is lost for good, the others take over its part. The memory that this takes grows
    with the number of tasks, by less than a kilobyte each: some thousand are well.

    Args:
        make_worker: Makes, once in each worker's process, what is called with each task.
        tasks: Small values that can be pickled; what they stand for is read in the workers.
        engine: Where.

    Raises:
        StereoweaveError: What a worker raised, or the cluster cannot be reached or has no room for a worker.
    """
    with connect(engine):
        waiting = dict(enumerate(tasks))
        while waiting:
            try:
                for index, result in _run(make_worker, waiting, engine):
                    del waiting[index]
                    yield result
            except _LostMachineError:
                continue


class _LostMachineError(Exception):
    """Workers wait for a machine that does not come back."""


def _run(
    make_worker: Callable[[], Callable[[Task], Result]], tasks: dict[int, Task], engine: Engine
) -> Iterator[tuple[int, Result]]:
    """Number and result of each task, until all are done or a machine is lost."""
    from ray.exceptions import RayError

    batches = _dataset(make_worker, tasks, engine).iter_batches(batch_size=None, prefetch_batches=0)
    try:
        for batch in batches:
            for index, content in zip(batch[_INDEX], batch[_CONTENT], strict=True):
                result, error = pickle.loads(content)
                if error:
                    raise error
                yield int(index), result
    except RayError as error:
        raise StereoweaveError(
            f"{engine.address or 'Ray'}: expected workers that begin, found {_last_line(error)}; "
            "see that all machines have the same Stereoweave, Ray and Python"
        ) from error


def _dataset(
    make_worker: Callable[[], Callable[[Task], Result]], tasks: dict[int, Task], engine: Engine
) -> "Dataset":
    """The results, which are made while they are read."""
    from ray.data import ActorPoolStrategy, DataContext, from_items

    logging.getLogger("ray.data").setLevel(logging.CRITICAL)
    most = min(engine.workers or len(tasks), len(tasks))
    pool = ActorPoolStrategy(min_size=1, initial_size=min(room(engine), most), max_size=most)
    rows = [{_INDEX: index, _CONTENT: pickle.dumps(task)} for index, task in tasks.items()]
    with DataContext.current(_context(engine)):
        return from_items(rows, override_num_blocks=len(rows)).map_batches(
            _Worker,
            fn_constructor_args=(make_worker, engine.threads_each),
            batch_size=None,
            compute=pool,
            num_cpus=engine.cpus_each,
            num_gpus=engine.gpus_each,
        )


def _context(engine: Engine) -> "DataContext":
    """How Ray Data works here: without a word, and with an eye on the machines."""
    from ray.data import DataContext

    with warnings.catch_warnings(action="ignore"):  # it warns of its own settings
        context = DataContext.get_current().copy()
    context.enable_progress_bars = False
    context.enable_auto_log_stats = False
    context.print_on_execution_start = False
    context.max_consecutive_actor_init_deaths = _MOST_FALSE_STARTS
    # A film, or a task of many pairs, may take longer than the half hour after which Ray Data gives up.
    context.execution_no_progress_timeout_s = -1
    watch: Any = partial(_Watch, engine)  # called as a class
    context.custom_execution_callback_classes = [watch]
    return context


class _Watch:
    """Called by Ray Data while it works; ends a run whose workers wait for a machine that was lost.

    Ray starts them again where there is room. Where there is none, what they had begun would wait for ever.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine, self._most = engine, 0
        self._looked_s = self._enough_s = -math.inf

    def before_execution_starts(self, _: object) -> None:
        self._enough_s = time.monotonic()

    def on_execution_step(self, _: object) -> None:
        now_s = time.monotonic()
        if now_s < self._looked_s + _LOOKED_AT_EVERY_S:
            return
        self._looked_s, room = now_s, _rooms(self._engine)
        self._most = max(self._most, min(room, self._engine.workers or room))
        if room >= self._most:
            self._enough_s = now_s
        elif room and now_s > self._enough_s + _BACK_WITHIN_S:
            raise _LostMachineError

    def after_execution_succeeds(self, _: object) -> None:
        pass

    def after_execution_fails(self, _: object, error: Exception) -> None:
        pass


def room(engine: Engine) -> int:
    """How many workers the machines have room for; StereoweaveError where there is none for a single one."""
    if found := _rooms(engine):
        return found
    largest = max(_machines(), key=lambda has: has.get("CPU", 0))
    raise StereoweaveError(
        f"--cpus-each, --gpus-each: expected a machine with {engine.cpus_each:g} cores and "
        f"{engine.gpus_each:g} GPUs for a worker, found {largest.get('CPU', 0):g} and "
        f"{largest.get('GPU', 0):g} in the largest; ask for less, or join such a machine"
    )


def _rooms(engine: Engine) -> int:
    return sum(_places(has, engine) for has in _machines())


def _machines() -> list[dict[str, float]]:
    """What each machine of the cluster has."""
    import ray

    nodes: list[dict[str, Any]] = ray.nodes()  # type: ignore[no-untyped-call]
    return [node["Resources"] for node in nodes if node["Alive"]]


def _places(has: dict[str, float], engine: Engine) -> int:
    """How many workers a machine has room for."""
    places = has.get("CPU", 0) / engine.cpus_each
    if engine.gpus_each:
        places = min(places, has.get("GPU", 0) / engine.gpus_each)
    return int(places + 1e-6)  # ten tenths are one


def _start() -> None:
    """Ray on this machine, with all cores that this process may use."""
    import ray

    # Ray starts the process of a dashboard in any case, and that asks the metadata services of three clouds,
    # though nothing is reported (2.60). If the port of that process is taken, Ray goes on without it.
    with _muted_stderr(), socket.create_server(("127.0.0.1", 0)) as taken:
        ray.init(
            address="local",
            num_cpus=usable_cores(),
            include_dashboard=False,
            dashboard_port=taken.getsockname()[1],
            object_store_memory=_OBJECT_STORE_BYTES,
            log_to_driver=False,
            logging_level=logging.ERROR,
        )


def _join(address: str) -> None:
    """Make this process a driver of the cluster at an address."""
    import ray

    try:
        with _muted_stderr():
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except Exception as error:  # Ray's own, gRPC's and Python's, which have no common base class
        raise _not_joined(address, _first_line(error)) from error


def _not_joined(address: str, found: str) -> StereoweaveError:
    return StereoweaveError(
        f"{address}: expected the head of a Ray cluster, found {found}; "
        "see that Ray and Python are of the cluster's versions, and that its token is here"
    )


def _check_head(address: str) -> None:
    """Raise an error if no head answers: `ray.init` would retry for minutes, and then exit the process.

    At a port of Ray's client (ray://) it gives up after half a minute, and raises an error itself.
    """
    try:
        if address != "auto":
            _check_port(address)
        if not address.startswith("ray://"):
            _check_status(address)
    except (OSError, subprocess.TimeoutExpired) as error:
        found = _first_line(error) if isinstance(error, OSError) else "something else that listens there"
        raise StereoweaveError(
            f"{address}: expected the head of a Ray cluster that answers, found {found}; "
            "is it started, and does a firewall let this machine through?"
        ) from error


def _check_port(address: str) -> None:
    """Raise an error if the address is malformed, an OSError if nothing listens at it."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not (host and port.isdigit() and 0 < int(port) < 65536):
        raise StereoweaveError(
            f"a cluster's address: expected host:port, ray://host:port, auto or local, found {address!r}"
        )
    socket.create_connection((host, int(port)), _CONNECTS_WITHIN_S).close()


def _check_status(address: str) -> None:
    """Raise an error if `ray status` fails; have Ray show its token if the head requires one.

    Ray shows none by default, and if it shows one to a head that requires none, actors end at once (2.60).

    Raises:
        StereoweaveError: The head refused: wrong version, wrong token.
        subprocess.TimeoutExpired: Nothing that understands Ray answers.
    """
    status = _status(address)
    if "AuthenticationError" in status.stderr and "RAY_AUTH_MODE" not in os.environ:
        os.environ["RAY_AUTH_MODE"] = "token"
        status = _status(address)
    if status.returncode:
        raise _not_joined(address, status.stderr.strip().splitlines()[-1].rstrip(".;"))


def _status(address: str) -> subprocess.CompletedProcess[str]:
    """The outcome of the command `ray status`, in a process of its own."""
    # -P: else a file in the current folder may have the name of a library.
    command = [sys.executable, "-P", "-m", "ray.scripts.scripts", "status", "--address", address]
    return subprocess.run(command, capture_output=True, text=True, timeout=_ANSWERS_WITHIN_S, check=False)


@contextmanager
def _muted_stderr() -> Iterator[None]:
    """Discard what Ray writes to the standard error: a line of C++ that it has read RAY_BACKEND_LOG_LEVEL."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _first_line(error: Exception) -> str:
    text = str(error) or type(error).__name__
    return text.splitlines()[0].rstrip(".;")


def _last_line(error: Exception) -> str:
    """Where Ray says what it came of."""
    return str(error).strip().splitlines()[-1].rstrip(".;")


class _Worker:
    """What lives in a worker's process: made once, called with a row for each task."""

    def __init__(self, make_worker: Callable[[], Callable[[Any], Any]], threads: int) -> None:
        import cv2

        cv2.setNumThreads(threads)
        self._make_worker = make_worker
        self._worker: Callable[[Any], Any] | None = None

    def __call__(self, batch: dict[str, Any]) -> dict[str, Any]:
        return {_INDEX: batch[_INDEX], _CONTENT: [self._outcome(content) for content in batch[_CONTENT]]}

    def _outcome(self, content: bytes) -> bytes:
        """The task's result, or what went wrong, which the driver raises: Ray would tell it in many lines."""
        try:
            if self._worker is None:
                self._worker = self._make_worker()
            return pickle.dumps((self._worker(pickle.loads(content)), None))
        except StereoweaveError as error:
            return pickle.dumps((None, error))
        except Exception as error:  # ours to mend: with all that it takes for that
            error.add_note(traceback.format_exc())
            return pickle.dumps((None, error))
