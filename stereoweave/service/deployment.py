"""HTTP service on Ray Serve: clients post pictures and receive depth or views.

Each replica has its own network. A request waits for the current batch to finish; then all waiting requests
are matched together.
"""

import asyncio
import logging
import math
import socket
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from prometheus_client import CollectorRegistry
from pydantic import BaseModel, ConfigDict, Field
from ray import serve
from ray.exceptions import RayActorError
from ray.serve.handle import DeploymentHandle
from ray.serve.schema import LoggingConfig

from stereoweave.errors import Remedy, StereoweaveError
from stereoweave.matching.backend import Backend
from stereoweave.matching.matcher import MODES, Matcher
from stereoweave.service.admission import Budget
from stereoweave.service.answers import ServiceAnswer, ServiceJob, load_answerer
from stereoweave.service.asgi import FAILURES, Guard, Limits, make_app
from stereoweave.service.folders import make_own_folder
from stereoweave.service.replica_processes import ReplicaProcesses, TimedJob
from stereoweave.service.server import ClientTimeouts, run_http_server
from stereoweave.system.child_process import ProcessDiedError
from stereoweave.system.ray_engine import (
    Engine,
    call_on_each_machine,
    connect,
    count_cores,
    count_slots,
    set_environment,
)
from stereoweave.system.threads import usable_cores

NAME = "stereoweave"
GPU_PROVIDERS = ("cuda", "tensorrt")
# Requests that resume together reach the batch within this time.
_GATHERING_S = 0.005
# All pairs of a batch are in memory at once, so a batch holds fewer pairs if they are large.
_MEGAPIXELS_AT_ONCE = 32
# Number of requests beyond the waiting ones. These are refused, or only check the service's health.
_MOST_QUEUED = 200
# A replica starts in seconds; the first replica on a machine also compiles the kernels.
_TRIAL_LIMIT_S = 120
# As long as Ray Serve waits for its proxies. By default it kills one after 5 s, too soon on a busy machine.
_PROXY_START_LIMIT_S = 60
_LOGGING = LoggingConfig(log_level="ERROR", enable_access_log=False)


class Settings(BaseModel):
    """Settings of the service.

    Attributes:
        model: As in `Matcher`.
        provider: As in `Matcher`.
        threads: Number of threads of each replica.
        replicas: Number of replicas; each is a process with its own network.
        batch: Maximum number of pairs to match together. On a CPU, larger batches are no faster: on two
            cores, a 640x480 pair takes 400 ms in batches of one, 390 ms in batches of two, and 405 ms in
            batches of four.
        limits: Limits of each replica.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    model: str = "small"
    provider: str = "cpu"
    threads: Annotated[int, Field(ge=1)] = 1
    replicas: Annotated[int, Field(ge=1)] = 1
    batch: Annotated[int, Field(ge=1)] = 1
    limits: Limits = Limits()

    @property
    def backend(self) -> Backend:
        """The backend of each replica."""
        return Backend(model=self.model, threads=self.threads, provider=self.provider)

    @property
    def gpus_each(self) -> int:
        """The number of GPUs reserved for each replica."""
        return 1 if self.provider in GPU_PROVIDERS else 0


@serve.ingress()
class Replica:
    """A process of the service that answers jobs and, on a cluster, also HTTP requests."""

    def __init__(self, settings: Settings) -> None:
        self._settings, self._resources = settings, ExitStack()
        self._folder = self._resources.enter_context(make_own_folder())
        self._processes = _make_processes(settings, self._folder)
        self._resources.callback(self._processes.close)
        self._budget = Budget(
            self._processes.warm_up(), settings.limits.timeout_s, refines=settings.model in MODES
        )
        # One thread per process: a call that waits for its thread has not been sent and can be cancelled.
        self._measuring_thread, self._answering_thread = ThreadPoolExecutor(1), ThreadPoolExecutor(1)
        self._idle = asyncio.Event()
        self._idle.set()
        self._answer_in_batch = serve.batch(
            max_batch_size=settings.batch, batch_wait_timeout_s=_GATHERING_S, batch_size_fn=self._count_share
        )(self._answer_batch)

    def __del__(self) -> None:  # Ray Serve calls this to stop a replica
        self._resources.close()

    def __serve_build_asgi_app__(self) -> Guard:
        limits = self._settings.limits
        return Guard(make_app(self._answer, limits, self._folder), limits)

    async def try_answer(self, job: ServiceJob, left_s: float) -> ServiceAnswer | Exception:
        """Return the answer to a job, or its error, within `left_s` seconds."""
        try:
            return await self._answer(job, left_s)
        except FAILURES as error:
            return error

    async def _answer(self, job: ServiceJob, left_s: float) -> ServiceAnswer:
        """Return the answer to a job. A job that is cancelled while waiting never starts."""
        deadline_s = time.monotonic() + left_s
        loop = asyncio.get_running_loop()
        megapixels = await loop.run_in_executor(self._measuring_thread, self._processes.measure, job, left_s)
        with self._budget.admit(job, megapixels, deadline_s - time.monotonic()):
            # Otherwise, each job that arrives while others are matched would become a batch of its own.
            await self._idle.wait()
            answer = await self._answer_in_batch(TimedJob(job, megapixels, deadline_s))
        if isinstance(answer, Exception):
            raise answer
        return answer

    async def _answer_batch(self, timed_jobs: list[TimedJob]) -> list[ServiceAnswer | Exception]:
        self._idle.clear()
        starting, start_s = self._processes.starting, time.perf_counter()
        try:
            loop = asyncio.get_running_loop()
            answers = await loop.run_in_executor(self._answering_thread, self._processes.answer, timed_jobs)
        finally:
            self._idle.set()
        # The time of a start tells nothing about the speed.
        if not starting and all(isinstance(answer, ServiceAnswer | TimeoutError) for answer in answers):
            work = sum(self._budget.estimate_work(timed.job, timed.megapixels) for timed in timed_jobs)
            finished = all(isinstance(answer, ServiceAnswer) for answer in answers)
            self._budget.learn(work, time.perf_counter() - start_s, finished=finished)
        return answers

    def _count_share(self, timed_jobs: Sequence[TimedJob]) -> int:
        """Return the number of places in a batch that the jobs fill; a large pair fills several places."""
        most = self._settings.batch
        return sum(
            min(math.ceil(timed.megapixels * most / _MEGAPIXELS_AT_ONCE), most) for timed in timed_jobs
        )


def application(settings: Settings) -> serve.Application:
    """Return the service as a Ray Serve application.

    Pass the application to `serve.run`, or refer to it as `stereoweave.service:application` in a Serve config
    file.
    """
    deployed = serve.deployment(
        name=NAME,
        num_replicas=settings.replicas,
        ray_actor_options={"num_cpus": settings.threads, "num_gpus": settings.gpus_each},
        max_ongoing_requests=settings.limits.waiting + _MOST_QUEUED,
        max_queued_requests=_MOST_QUEUED,
        graceful_shutdown_timeout_s=settings.limits.timeout_s,
        # If a network fails to load, further attempts would fail too.
        max_constructor_retry_count=2,
        logging_config=_LOGGING,
    )
    return deployed(Replica).bind(settings)


@contextmanager
def run_service(settings: Settings, listener: socket.socket, address: str | None = None) -> Iterator[None]:
    """Run the service until the end of the block, then finish the accepted requests.

    Args:
        settings: Settings of the service.
        listener: The socket to listen on. On a cluster, it is closed, and Ray's own proxies listen on the
            same port on each machine that has a replica.
        address: As in `Engine`; the cluster must not serve another application.

    Raises:
        StereoweaveError: If the replicas do not fit, Ray cannot be reached, or the network does not load.
    """
    address = set_environment(address)
    # Without an address, an engine would join the cluster in RAY_ADDRESS.
    engine = Engine(address or "local", cpus_each=settings.threads, gpus_each=settings.gpus_each)
    if address is None:
        _check_slots(settings, usable_cores() // settings.threads)
        # Report a network's errors before Ray starts, because starting Ray takes seconds.
        Matcher(settings.model, provider=settings.provider)
    logging.getLogger("ray.serve").setLevel(logging.CRITICAL)
    with connect(engine):
        _check_free(address)
        _check_slots(settings, _count_replica_slots(engine))
        with (_serve_at_proxies if address else _serve_at_server)(settings, listener):
            yield


@contextmanager
def _serve_at_server(settings: Settings, listener: socket.socket) -> Iterator[None]:
    """Serve from an HTTP server in this process that passes jobs to the replicas."""
    limits = settings.limits
    limits = limits.model_copy(update={"waiting": limits.waiting * settings.replicas})
    serve.start(proxy_location="Disabled", logging_config=_LOGGING)
    with ExitStack() as ending:
        ending.callback(_stop_replicas)
        handle = _start_replicas(settings)

        async def answer(job: ServiceJob, left_s: float) -> ServiceAnswer:
            response = handle.try_answer.remote(job, left_s)
            try:
                outcome = await response
            except asyncio.CancelledError:
                response.cancel()  # type: ignore[no-untyped-call]
                raise
            except RayActorError as error:
                raise ProcessDiedError(
                    "the replica exited before it answered the request; try again later"
                ) from error
            if isinstance(outcome, Exception):
                raise outcome
            return outcome

        folder = ending.enter_context(make_own_folder())
        registry = CollectorRegistry()
        app = Guard(make_app(answer, limits, folder, registry), limits, registry)
        ending.enter_context(run_http_server(app, listener, ClientTimeouts(end_s=limits.timeout_s)))
        yield


@contextmanager
def _serve_at_proxies(settings: Settings, listener: socket.socket) -> Iterator[None]:
    """Serve from Ray Serve's HTTP proxies, one on each machine."""
    host, port = listener.getsockname()[:2]
    listener.close()
    try:
        _start_proxies(host, port)
        _start_replicas(settings)
        yield
    finally:
        _stop_replicas()
        # Also after a failed start: Ray Serve would stay, and the next service could not change its port.
        serve.shutdown()  # type: ignore[no-untyped-call]


def _start_proxies(host: str, port: int) -> None:
    """Start Ray Serve's HTTP proxies and wait until they are ready."""
    # Ray's name for it; read by the controller alone, which is a process on any machine of the cluster.
    limit = {"RAY_SERVE_PROXY_READY_CHECK_TIMEOUT_S": str(_PROXY_START_LIMIT_S)}
    try:
        serve.start(
            http_options={"host": host, "port": port},
            logging_config=_LOGGING,
            controller_options={"runtime_env": {"env_vars": limit}},
        )
    except (RayActorError, TimeoutError) as error:
        found = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
        raise StereoweaveError(
            f"Ray Serve: expected HTTP proxies that are ready within {_PROXY_START_LIMIT_S} s, found: {found}"
            "; is a machine of the cluster overloaded?"
        ) from error


def _check_free(address: str | None) -> None:
    """Raise an error if the cluster already serves applications.

    Ray Serve cannot listen on a second port.
    """
    others = serve.status().applications
    if others:
        raise StereoweaveError(
            f"{address}: expected a cluster without Serve applications, found {', '.join(others)}; stop them "
            "with `serve shutdown`, or add stereoweave.service:application to their Serve config file"
        )


def _start_replicas(settings: Settings) -> DeploymentHandle[Any]:
    """Start the replicas and wait until their networks are loaded."""
    try:
        return serve.run(application(settings), name=NAME, route_prefix="/")
    except RuntimeError as error:
        cause = StereoweaveError.from_error(_find_start_error(settings) or error)
        cause = cause.with_prefix("a replica could not load the network: ")
        raise cause.with_detail("is the model available on every machine of the service?") from error


def _find_start_error(settings: Settings) -> StereoweaveError | None:
    """Return the error that prevents replicas from starting; None if no machine reproduces it.

    Each machine tries to start a replica's processes, because Ray Serve reports errors only as text.
    """
    _stop_replicas()  # replicas that have started may leave no room for the trials
    engine = Engine(cpus_each=settings.threads, gpus_each=settings.gpus_each)
    errors = call_on_each_machine(_try_start, settings, engine, _TRIAL_LIMIT_S)
    return next(filter(None, errors), None)


def _try_start(settings: Settings) -> StereoweaveError | None:
    """Start a replica's processes as a trial; return the error, if any."""
    try:
        with make_own_folder() as folder, closing(_make_processes(settings, folder)) as processes:
            processes.warm_up()
    except StereoweaveError as error:
        return error
    return None


def _make_processes(settings: Settings, folder: Path) -> ReplicaProcesses:
    return ReplicaProcesses(partial(load_answerer, settings.backend), folder)


def _stop_replicas() -> None:
    """Stop each replica after it has answered its accepted requests."""
    while NAME in serve.status().applications:
        with suppress(TimeoutError):  # raised after a minute, but a request may take longer
            serve.delete(NAME)


def _check_slots(settings: Settings, found: int) -> None:
    """Raise an error if the replicas do not fit, because Ray would otherwise wait silently for more room."""
    if settings.replicas > found:
        gpu = " and a GPU" if settings.gpus_each else ""
        raise StereoweaveError(
            f"expected at most {found}, because each takes {count_cores(settings.threads)}{gpu}, "
            f"found {settings.replicas}",
            setting="replicas",
            remedy=Remedy("use lower values", ("replicas", "threads")),
        )


def _count_replica_slots(engine: Engine) -> int:
    """Return the number of replicas that fit on the cluster."""
    try:
        return count_slots(engine)
    except StereoweaveError:  # no replica fits, and the error names settings of another command
        return 0
