"""Runs the HTTP service on Ray Serve: clients post pictures and receive depth or views.

Each replica has its own network. A request waits for the current batch to finish; then all waiting requests
are matched together.
"""

import asyncio
import logging
import math
import os
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
from stereoweave.matching.matcher import Matcher
from stereoweave.service.admission import Budget, work_of
from stereoweave.service.answers import Answer, ServiceJob, make_answering
from stereoweave.service.asgi import FAILURES, Guard, Limits, make_app
from stereoweave.service.folders import own_folder
from stereoweave.service.server import Patience, http_server
from stereoweave.service.worker import Task, Worker
from stereoweave.system.child_process import ProcessDiedError
from stereoweave.system.ray_engine import Engine, call_on_each_machine, connect, room
from stereoweave.system.threads import usable_cores

NAME = "stereoweave"
GPU_PROVIDERS = ("cuda", "tensorrt")
# Requests that wake up together arrive within this time.
_GATHERED_WITHIN_S = 0.005
# All pairs of a batch are in memory at once, so a batch holds fewer large ones.
_MEGAPIXELS_AT_ONCE = 32
# In addition to waiting requests: these are refused, or ask for its health.
_MOST_AT_DOOR = 200
# A replica starts in seconds; the first on a machine also compiles the kernels.
_TRIAL_WITHIN_S = 120
_QUIET = LoggingConfig(log_level="ERROR", enable_access_log=False)


class Settings(BaseModel):
    """Settings of the service.

    Attributes:
        model: As in `Matcher`.
        provider: As in `Matcher`.
        threads: Threads of each replica.
        replicas: The number of processes, each with its own network.
        batch: The maximum number of pairs to match together. On a CPU a batch is no faster: on two cores a
            pair of 640x480 px takes 400, 390 and 405 ms in batches of one, two and four.
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
        """What each replica matches with."""
        return Backend(model=self.model, threads=self.threads, provider=self.provider)

    @property
    def gpus_each(self) -> int:
        """The number of GPUs reserved for each replica."""
        return 1 if self.provider in GPU_PROVIDERS else 0


@serve.ingress()
class Replica:
    """A process of the service that answers jobs; on a cluster also HTTP requests."""

    def __init__(self, settings: Settings) -> None:
        self._settings, self._opened = settings, ExitStack()
        self._folder = self._opened.enter_context(own_folder())
        self._worker = _make_worker(settings, self._folder)
        self._opened.callback(self._worker.close)
        self._budget = Budget(self._worker.warm_up())
        # One thread for each process of the worker: calls that wait for it are not sent yet, and can be
        # cancelled.
        self._measuring, self._answering = ThreadPoolExecutor(1), ThreadPoolExecutor(1)
        self._free = asyncio.Event()
        self._free.set()
        self._together = serve.batch(
            max_batch_size=settings.batch, batch_wait_timeout_s=_GATHERED_WITHIN_S, batch_size_fn=self._size
        )(self._answered)

    def __del__(self) -> None:  # Ray Serve calls it to end a replica
        self._opened.close()

    def __serve_build_asgi_app__(self) -> Guard:
        limits = self._settings.limits
        return Guard(make_app(self._answer, limits, self._folder), limits)

    async def outcome(self, job: ServiceJob, left_s: float) -> Answer | Exception:
        """The answer to a job within the seconds that are left for it, or the error."""
        try:
            return await self._answer(job, left_s)
        except FAILURES as error:
            return error

    async def _answer(self, job: ServiceJob, left_s: float) -> Answer:
        """The answer to a job. A job that is cancelled while it waits never starts."""
        deadline_s = time.monotonic() + left_s
        loop = asyncio.get_running_loop()
        megapixels = await loop.run_in_executor(self._measuring, self._worker.measure, job, left_s)
        with self._budget.admit(job, megapixels, deadline_s - time.monotonic()):
            # Otherwise each job that arrives during a match would become a batch of its own.
            await self._free.wait()
            answer = await self._together(Task(job, megapixels, deadline_s))
        if isinstance(answer, Exception):
            raise answer
        return answer

    async def _answered(self, tasks: list[Task]) -> list[Answer | Exception]:
        self._free.clear()
        start_s = time.perf_counter()
        try:
            loop = asyncio.get_running_loop()
            answers = await loop.run_in_executor(self._answering, self._worker.answer, tasks)
        finally:
            self._free.set()
        if all(isinstance(answer, Answer | TimeoutError) for answer in answers):
            work = sum(work_of(task.job, task.megapixels) for task in tasks)
            finished = all(isinstance(answer, Answer) for answer in answers)
            self._budget.learn(work, time.perf_counter() - start_s, finished=finished)
        return answers

    def _size(self, tasks: Sequence[Task]) -> int:
        """The share of a batch that tasks fill, in pairs."""
        most = self._settings.batch
        return sum(min(math.ceil(task.megapixels * most / _MEGAPIXELS_AT_ONCE), most) for task in tasks)


def application(settings: Settings) -> serve.Application:
    """The service for `serve.run`, and as stereoweave.service:application for a Serve config file."""
    deployed = serve.deployment(
        name=NAME,
        num_replicas=settings.replicas,
        ray_actor_options={"num_cpus": settings.threads, "num_gpus": settings.gpus_each},
        max_ongoing_requests=settings.limits.waiting + _MOST_AT_DOOR,
        max_queued_requests=_MOST_AT_DOOR,
        graceful_shutdown_timeout_s=settings.limits.timeout_s,
        # If a network fails to load, further tries fail too.
        max_constructor_retry_count=2,
        logging_config=_QUIET,
    )
    return deployed(Replica).bind(settings)


@contextmanager
def serving(settings: Settings, listener: socket.socket, address: str | None = None) -> Iterator[None]:
    """Run the service within the block; at its end finish the accepted requests.

    Args:
        settings: Settings of the service.
        listener: The socket to serve at. On a cluster it is closed, and Ray's own proxies listen at its port
            on each machine that has a replica.
        address: As in `Engine`; the cluster must not serve another application.

    Raises:
        StereoweaveError: If the replicas do not fit, Ray cannot be reached, or the network does not load.
    """
    address = address or os.environ.get("RAY_ADDRESS")
    engine = Engine(address, cpus_each=settings.threads, gpus_each=settings.gpus_each)
    if address is None:
        _check_room(settings, usable_cores() // settings.threads)
        # Report its errors before Ray starts, which takes seconds.
        Matcher(settings.model, provider=settings.provider)
    logging.getLogger("ray.serve").setLevel(logging.CRITICAL)
    with connect(engine):
        _check_free(address)
        _check_room(settings, _room(engine))
        with (_at_proxies if address else _at_server)(settings, listener):
            yield


@contextmanager
def _at_server(settings: Settings, listener: socket.socket) -> Iterator[None]:
    """Serve from an HTTP server in this process that passes jobs to the replicas."""
    limits = settings.limits
    limits = limits.model_copy(update={"waiting": limits.waiting * settings.replicas})
    serve.start(proxy_location="Disabled", logging_config=_QUIET)
    with ExitStack() as ending:
        ending.callback(_end)
        handle = _run(settings)

        async def answer(job: ServiceJob, left_s: float) -> Answer:
            response = handle.outcome.remote(job, left_s)
            try:
                outcome = await response
            except asyncio.CancelledError:
                response.cancel()  # type: ignore[no-untyped-call]
                raise
            except RayActorError as error:
                raise ProcessDiedError(
                    "expected a replica that answers, found that it ended; try again later"
                ) from error
            if isinstance(outcome, Exception):
                raise outcome
            return outcome

        folder = ending.enter_context(own_folder())
        registry = CollectorRegistry()
        app = Guard(make_app(answer, limits, folder, registry), limits, registry)
        ending.enter_context(http_server(app, listener, Patience(end_s=limits.timeout_s)))
        yield


@contextmanager
def _at_proxies(settings: Settings, listener: socket.socket) -> Iterator[None]:
    """Serve from the HTTP proxies of Ray Serve, one on each machine."""
    host, port = listener.getsockname()[:2]
    listener.close()
    serve.start(http_options={"host": host, "port": port}, logging_config=_QUIET)
    try:
        _run(settings)
        yield
    finally:
        _end()
        serve.shutdown()  # type: ignore[no-untyped-call]


def _check_free(address: str | None) -> None:
    """Raise an error if the cluster serves already: Ray Serve cannot listen at a second port."""
    others = serve.status().applications
    if others:
        raise StereoweaveError(
            f"{address}: expected a cluster that serves nothing yet, found {', '.join(others)}; "
            "`serve shutdown` ends that, or add stereoweave.service:application to its Serve config file"
        )


def _run(settings: Settings) -> DeploymentHandle[Any]:
    """Start the replicas and wait until their networks are loaded."""
    try:
        return serve.run(application(settings), name=NAME, route_prefix="/")
    except RuntimeError as error:
        cause = StereoweaveError.from_error(_find_start_error(settings) or error)
        cause = cause.with_prefix("expected a network that loads where the service runs, found ")
        raise cause.with_detail("is the model there too?") from error


def _find_start_error(settings: Settings) -> StereoweaveError | None:
    """Return why replicas did not start, from a trial on each machine: Ray Serve reports it only as text."""
    _end()  # replicas that did start may leave no room
    engine = Engine(cpus_each=settings.threads, gpus_each=settings.gpus_each)
    errors = call_on_each_machine(_try_start, settings, engine, _TRIAL_WITHIN_S)
    return next(filter(None, errors), None)


def _try_start(settings: Settings) -> StereoweaveError | None:
    """Do what a replica does to start; return the error, if any."""
    try:
        with own_folder() as folder, closing(_make_worker(settings, folder)) as worker:
            worker.warm_up()
    except StereoweaveError as error:
        return error
    return None


def _make_worker(settings: Settings, folder: Path) -> Worker:
    return Worker(partial(make_answering, settings.backend), folder)


def _end() -> None:
    """End the replicas, each after its accepted requests."""
    while NAME in serve.status().applications:
        with suppress(TimeoutError):  # raised after a minute; a request may take longer
            serve.delete(NAME)


def _check_room(settings: Settings, found: int) -> None:
    """Raise an error if the replicas do not fit: Ray would wait for more room without a message."""
    if settings.replicas > found:
        gpu = " and a GPU" if settings.gpus_each else ""
        raise StereoweaveError(
            f"expected at most {found}, for which there is room, found {settings.replicas}; each takes "
            f"{settings.threads} cores{gpu}",
            setting="replicas",
            remedy=Remedy("ask for less", ("replicas", "threads")),
        )


def _room(engine: Engine) -> int:
    """The number of replicas that fit on the cluster."""
    try:
        return room(engine)
    except StereoweaveError:  # none fits; the error names settings of another command
        return 0
