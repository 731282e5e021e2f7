"""Engine that streams tasks through a pool of Ray Data workers on one or many machines."""

import logging
import math
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from importlib.metadata import distribution
from typing import TYPE_CHECKING, Any, TypeVar

from stereoweave.errors import Remedy, StereoweaveError, require_extra
from stereoweave.system.threads import usable_cores

if TYPE_CHECKING:
    from ray.data import DataContext, Dataset

TaskT = TypeVar("TaskT")
ResultT = TypeVar("ResultT")

_CONNECT_TIMEOUT_S, _STATUS_TIMEOUT_S = 10, 20
# The object store carries only tasks and results.
_OBJECT_STORE_BYTES = 200_000_000
# Interval between checks of a cluster's machines, and the time that a lost machine has to return.
_CHECKED_EVERY_S, _RETURNS_WITHIN_S = 2, 10
# Ray counts cores and GPUs at this resolution.
_LEAST_SHARE = 0.0001
# The run fails after this many consecutive workers die while starting.
_MOST_FALSE_STARTS = 20
_QUIET_ENVIRONMENT = {
    # Hide deprecation warnings, and errors from Ray's C++ code; important errors are also raised in Python.
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_BACKEND_LOG_LEVEL": "fatal",
    # Keep the cluster's logs, with a line for each killed worker, off standard output.
    "RAY_DEDUP_LOGS_SKIP_REGEX": ".*",
}
# If this is 0, the default on macOS and Windows, a Ray instance started here uses the loopback address for
# its machine and listens only there. A loopback address passed to `ray.init` has no effect, because Ray
# replaces it.
_OPEN_TO_OTHER_MACHINES = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
_LOCAL_ENVIRONMENT = {
    _OPEN_TO_OTHER_MACHINES: "0",
    # By default, Ray lowers the priority of its workers to 15: beside other programs that keep all cores busy
    # they, and the processes that they start, would get a thirtieth of the time.
    "RAY_worker_niceness": "0",
}
_INDEX, _CONTENT = "index", "content"


@dataclass(frozen=True)
class Engine:
    """A Ray cluster, and the number and size of the workers on it.

    Attributes:
        address: The cluster's head as host:port or ray://host:port; "auto" for a Ray instance already
            running on this machine; "local" to start Ray on this machine for the duration of the work.
            Default: the address in RAY_ADDRESS, or "local" if RAY_ADDRESS is not set.
        workers: Maximum number of workers; default: as many as fit.
        cpus_each: Number of cores reserved for each worker; fractions are allowed.
        gpus_each: Number of GPUs reserved for each worker; at 0.25, four workers share a GPU.
    """

    address: str | None = None
    workers: int | None = None
    cpus_each: float = 1
    gpus_each: float = 0

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise StereoweaveError(f"expected 1 or more, found {self.workers}", setting="workers")
        if not _LEAST_SHARE <= self.cpus_each < math.inf:
            raise StereoweaveError(
                f"expected {_LEAST_SHARE} or more, found {self.cpus_each}", setting="cpus_each"
            )
        gpus = self.gpus_each
        if gpus and not (_LEAST_SHARE <= gpus < 1 or (1 <= gpus < math.inf and gpus % 1 == 0)):
            raise StereoweaveError(
                f"expected 0, a fraction below 1, or a whole number, found {gpus}", setting="gpus_each"
            )

    @property
    def threads_each(self) -> int:
        """The number of threads that a worker may use."""
        return max(1, int(self.cpus_each))


def set_environment(address: str | None) -> str | None:
    """Set the environment variables that Ray reads on import, except those that the user has set.

    Returns:
        The address of the cluster to join; None if Ray must be started on this machine, where it will listen
        only on the loopback address.
    """
    for name, value in _QUIET_ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    address = address or os.environ.get("RAY_ADDRESS")
    if address and address != "local":
        return address
    for name, value in _LOCAL_ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    return None


@contextmanager
def connect(engine: Engine) -> Iterator[None]:
    """Make this process a Ray driver within the block, unless it already is one.

    Raises:
        StereoweaveError: If Ray is not installed, or no Ray head answers at the address.
    """
    address = set_environment(engine.address)
    with require_extra("cluster", "this needs Ray"):
        already = "ray" in sys.modules and sys.modules["ray"].is_initialized()
        if address and not already:
            distribution("ray")  # raises ModuleNotFoundError without importing Ray
            _check_head(address)  # before the import, during which Ray reads whether to send a token
        import ray
    if already:
        yield
        return
    with _keep_sigterm_handler():
        _join(address) if address else _start()
    try:
        yield
    finally:
        ray.shutdown()


@contextmanager
def _keep_sigterm_handler() -> Iterator[None]:
    """Keep the program's own handler of SIGTERM, which `ray.init` replaces."""
    handler = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        if handler is not signal.getsignal(signal.SIGTERM) and handler not in (signal.SIG_DFL, None):
            signal.signal(signal.SIGTERM, handler)


def stream(
    make_worker: Callable[[], Callable[[TaskT], ResultT]], tasks: Sequence[TaskT], engine: Engine
) -> Generator[ResultT, None, None]:
    """Yield the tasks' results as they arrive, in any order.

    If a worker or a machine dies, its tasks run again. A task may run twice, but its result is yielded only
    once. If a machine does not return, the other machines take over its tasks. Memory use grows by less than
    a kilobyte per task, so there can be thousands of tasks.

    Args:
        make_worker: Function that is called once in each worker's process, and returns the function to call
            with each task.
        tasks: Small values that can be pickled; workers load larger data themselves.
        engine: The cluster and its workers.

    Raises:
        StereoweaveError: If a worker raises one, the cluster cannot be reached, or no machine fits a worker.
    """
    with connect(engine):
        waiting = dict(enumerate(tasks))
        while waiting:
            try:
                for index, result in _run_tasks(make_worker, waiting, engine):
                    del waiting[index]
                    yield result
            except _LostMachineError:
                continue


def call_on_each_machine(
    function: Callable[[TaskT], ResultT], argument: TaskT, engine: Engine, timeout_s: float
) -> list[ResultT]:
    """Call a function on each machine that has room for a worker, and return the results.

    Each call reserves a worker's resources. This process must be a driver of the cluster; see `connect`.

    Returns:
        The results from all machines that neither fail nor exceed the time limit.
    """
    import ray
    from ray.exceptions import RayError
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    remote: Any = ray.remote(num_cpus=engine.cpus_each, num_gpus=engine.gpus_each, max_retries=0)(function)
    calls = [
        remote.options(scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=False)).remote(argument)
        for node, resources in _list_machines().items()
        if _count_machine_slots(resources, engine)
    ]
    results = []
    for call in ray.wait(calls, num_returns=len(calls), timeout=timeout_s)[0] if calls else []:
        with suppress(RayError):
            results.append(ray.get(call))
    return results


class _LostMachineError(Exception):
    """Error for a run whose workers wait for a machine that does not return."""


def _run_tasks(
    make_worker: Callable[[], Callable[[TaskT], ResultT]], tasks: dict[int, TaskT], engine: Engine
) -> Iterator[tuple[int, ResultT]]:
    """Yield each task's number and result as soon as the task finishes.

    Raises:
        StereoweaveError: A worker raised one, or the workers failed.
        _LostMachineError: A machine was lost and did not return.
    """
    from ray.exceptions import RayError

    batches = _make_dataset(make_worker, tasks, engine).iter_batches(batch_size=None, prefetch_batches=0)
    try:
        for batch in batches:
            for index, content in zip(batch[_INDEX], batch[_CONTENT], strict=True):
                result, error = pickle.loads(content)
                if error:
                    raise error
                yield int(index), result
    except RayError as error:
        raise StereoweaveError(
            f"{engine.address or 'Ray'}: the workers failed: {_last_line(error)}; "
            "check that all machines have the same versions of Stereoweave, Ray and Python"
        ) from error


def _make_dataset(
    make_worker: Callable[[], Callable[[TaskT], ResultT]], tasks: dict[int, TaskT], engine: Engine
) -> "Dataset":
    """Return a lazy dataset of the results; the tasks run while the dataset is read."""
    from ray.data import ActorPoolStrategy, DataContext, from_items

    logging.getLogger("ray.data").setLevel(logging.CRITICAL)
    most = min(engine.workers or len(tasks), len(tasks))
    pool = ActorPoolStrategy(min_size=1, initial_size=min(count_slots(engine), most), max_size=most)
    rows = [{_INDEX: index, _CONTENT: pickle.dumps(task)} for index, task in tasks.items()]
    with DataContext.current(_make_context(engine)):
        return from_items(rows, override_num_blocks=len(rows)).map_batches(
            _TaskRunner,
            fn_constructor_args=(make_worker, engine.threads_each),
            batch_size=None,
            compute=pool,
            num_cpus=engine.cpus_each,
            num_gpus=engine.gpus_each,
        )


def _make_context(engine: Engine) -> "DataContext":
    """Return settings for Ray Data that turn off its output and add a callback that watches the machines."""
    from ray.data import DataContext

    with warnings.catch_warnings(action="ignore"):  # Ray Data warns about its own defaults
        context = DataContext.get_current().copy()
    context.enable_progress_bars = False
    context.enable_auto_log_stats = False
    context.print_on_execution_start = False
    context.max_consecutive_actor_init_deaths = _MOST_FALSE_STARTS
    # A video, or a task of many pairs, may take longer than half an hour, after which Ray Data would give up.
    context.execution_no_progress_timeout_s = -1
    watch: Any = partial(_Watch, engine)  # Ray Data calls it like a class
    context.custom_execution_callback_classes = [watch]
    return context


class _Watch:
    """Ray Data callback that stops a run whose workers wait for a lost machine.

    Ray restarts such workers if there is room on other machines. Otherwise, their tasks would wait forever.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine, self._most_slots = engine, 0
        self._checked_s = self._complete_s = -math.inf

    def before_execution_starts(self, _: object) -> None:
        self._complete_s = time.monotonic()

    def on_execution_step(self, _: object) -> None:
        now_s = time.monotonic()
        if now_s < self._checked_s + _CHECKED_EVERY_S:
            return
        self._checked_s, slots = now_s, _count_slots(self._engine)
        self._most_slots = max(self._most_slots, min(slots, self._engine.workers or slots))
        if slots >= self._most_slots:
            self._complete_s = now_s
        elif slots and now_s > self._complete_s + _RETURNS_WITHIN_S:
            raise _LostMachineError

    def after_execution_succeeds(self, _: object) -> None:
        pass

    def after_execution_fails(self, _: object, error: Exception) -> None:
        pass


def count_slots(engine: Engine) -> int:
    """Return the number of workers that fit on the cluster; raise StereoweaveError if no worker fits."""
    if slots := _count_slots(engine):
        return slots
    largest = max(_list_machines().values(), key=lambda resources: resources.get("CPU", 0))
    gpus = "1 GPU" if engine.gpus_each == 1 else f"{engine.gpus_each:g} GPUs"
    raise StereoweaveError(
        f"expected a machine with {count_cores(engine.cpus_each)} and {gpus} for a worker, "
        f"found {largest.get('CPU', 0):g} and {largest.get('GPU', 0):g} on the largest; add a larger machine",
        remedy=Remedy("or use lower values", ("cpus_each", "gpus_each")),
    )


def count_cores(cores: float) -> str:
    """Return a number of cores in words."""
    return "1 core" if cores == 1 else f"{cores:g} cores"


def _count_slots(engine: Engine) -> int:
    return sum(_count_machine_slots(resources, engine) for resources in _list_machines().values())


def _list_machines() -> dict[str, dict[str, float]]:
    """Return the resources of each live machine in the cluster, by machine ID."""
    import ray

    nodes: list[dict[str, Any]] = ray.nodes()  # type: ignore[no-untyped-call]
    return {node["NodeID"]: node["Resources"] for node in nodes if node["Alive"]}


def _count_machine_slots(resources: dict[str, float], engine: Engine) -> int:
    """Return the number of workers that fit on a machine."""
    slots = resources.get("CPU", 0) / engine.cpus_each
    if engine.gpus_each:
        slots = min(slots, resources.get("GPU", 0) / engine.gpus_each)
    return int(slots + 1e-6)  # tolerates rounding: 0.3 / 0.1 must be 3


def _start() -> None:
    """Start Ray on this machine with all cores that this process may use."""
    import ray

    # Ray always starts a dashboard process, which queries the metadata services of three clouds even if
    # telemetry is off (Ray 2.60). If the port of that process is in use, Ray continues without the process.
    with _mute_stderr(), socket.create_server(("127.0.0.1", 0)) as occupied:
        ray.init(
            address="local",
            num_cpus=usable_cores(),
            include_dashboard=False,
            dashboard_port=occupied.getsockname()[1],
            object_store_memory=_OBJECT_STORE_BYTES,
            log_to_driver=False,
            logging_level=logging.ERROR,
        )


def _join(address: str) -> None:
    """Make this process a driver of the cluster at an address."""
    import ray

    try:
        with _mute_stderr():
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except Exception as error:  # errors from Ray, gRPC and Python have no common base class
        raise _make_join_error(address, _first_line(error)) from error


def _make_join_error(address: str, found: str) -> StereoweaveError:
    return StereoweaveError(
        f"{address}: expected the head of a Ray cluster, found none that can be joined ({found}); "
        "check that this machine has the cluster's token and the same versions of Ray and Python"
    )


def _check_head(address: str) -> None:
    """Raise an error if no Ray head answers.

    Otherwise, `ray.init` would retry for minutes and then exit the process. For Ray Client (ray://), only the
    port is checked, because `ray.init` then gives up after half a minute and raises an error itself.
    """
    try:
        if address != "auto":
            _check_port(address)
        if not address.startswith("ray://"):
            _check_status(address)
    except (OSError, subprocess.TimeoutExpired) as error:
        found = _first_line(error) if isinstance(error, OSError) else f"no reply in {_STATUS_TIMEOUT_S} s"
        raise StereoweaveError(
            f"{address}: expected the head of a Ray cluster, found none ({found}); "
            "is it running, and does the firewall let this machine through?"
        ) from error


def _check_port(address: str) -> None:
    """Raise a StereoweaveError if the address is malformed, or an OSError if nothing is listening there."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not (host and port.isdigit() and 0 < int(port) < 65536):
        raise StereoweaveError(
            f"cluster address: expected host:port, ray://host:port, auto or local, found {address!r}"
        )
    socket.create_connection((host, int(port)), _CONNECT_TIMEOUT_S).close()


def _check_status(address: str) -> None:
    """Raise an error if `ray status` fails; make Ray send its token if the head requires one.

    By default, Ray sends no token. If Ray sends a token to a head that requires none, actors exit at once
    (Ray 2.60).

    Raises:
        StereoweaveError: The head rejected the version or the token.
        subprocess.TimeoutExpired: No Ray head replied in time.
    """
    status = _run_status_command(address)
    if "AuthenticationError" in status.stderr and "RAY_AUTH_MODE" not in os.environ:
        os.environ["RAY_AUTH_MODE"] = "token"
        status = _run_status_command(address)
    if status.returncode:
        lines = status.stderr.strip().splitlines() or [f"exit status {status.returncode}"]
        raise _make_join_error(address, lines[-1].rstrip(".;"))


def _run_status_command(address: str) -> subprocess.CompletedProcess[str]:
    """Run `ray status` in a separate process, and return its outcome."""
    # -P: otherwise a file in the current folder could shadow a library.
    command = [sys.executable, "-P", "-m", "ray.scripts.scripts", "status", "--address", address]
    return subprocess.run(command, capture_output=True, text=True, timeout=_STATUS_TIMEOUT_S, check=False)


@contextmanager
def _mute_stderr() -> Iterator[None]:
    """Discard standard error within the block.

    Otherwise, Ray's C++ code would print a line about RAY_BACKEND_LOG_LEVEL.
    """
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
    """Return the last line of a Ray error, which names the cause."""
    return str(error).strip().splitlines()[-1].rstrip(".;")


class _TaskRunner:
    """Callable that Ray Data creates once in each worker process and calls once for each task."""

    def __init__(self, make_worker: Callable[[], Callable[[Any], Any]], threads: int) -> None:
        import cv2

        cv2.setNumThreads(threads)
        self._make_worker = make_worker
        self._worker: Callable[[Any], Any] | None = None

    def __call__(self, batch: dict[str, Any]) -> dict[str, Any]:
        return {_INDEX: batch[_INDEX], _CONTENT: [self._run_task(content) for content in batch[_CONTENT]]}

    def _run_task(self, content: bytes) -> bytes:
        """Run a task, and return its pickled result, or its pickled error for the driver to raise.

        Ray's own error report would have many lines.
        """
        try:
            if self._worker is None:
                self._worker = self._make_worker()
            return pickle.dumps((self._worker(pickle.loads(content)), None))
        except StereoweaveError as error:
            return pickle.dumps((None, error))
        except Exception as error:  # a bug: keep the traceback
            error.add_note(traceback.format_exc())
            return pickle.dumps((None, error))
