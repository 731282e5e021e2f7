"""The service: pictures are posted, depth and views come back. Ray Serve runs it.

Each replica has a network of its own. A request waits until what came before it is matched, and is then
matched together with those that waited with it.
"""

import asyncio
import logging
import math
import os
import re
import urllib.request
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Annotated

import ray
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import Metric
from prometheus_client.parser import text_string_to_metric_families
from prometheus_client.registry import Collector
from pydantic import BaseModel, ConfigDict, Field
from ray import serve
from ray.serve.schema import LoggingConfig

from stereoweave.engine import Engine, connect, room
from stereoweave.errors import StereoweaveError
from stereoweave.matcher import Matcher
from stereoweave.service_http import Guard, Limits, make_app
from stereoweave.service_requests import Answer, Order, answer_many
from stereoweave.threads import usable_cores

NAME = "stereoweave"
GPU_PROVIDERS = ("cuda", "tensorrt")
# Those that are woken together come within this.
_GATHERED_WITHIN_S = 0.005
# The pairs of a batch are in memory at once: of large ones there are fewer.
_MEGAPIXELS_AT_ONCE = 32
# Beyond those that wait: it refuses them, or says how it is.
_MOST_AT_DOOR = 200
# Of what Ray counts: pairs matched together, requests accepted, requests that wait before replicas.
_METRICS = (
    r"ray_(stereoweave_|serve_(actual_batch_size|replica_processing_queries|deployment_queued_queries))"
)
_METRICS_WITHIN_S = 5
_QUIET = LoggingConfig(log_level="ERROR", enable_access_log=False)


class Settings(BaseModel):
    """What the service is made of.

    Attributes:
        model: As for `Matcher`.
        provider: Likewise.
        threads: Likewise, of each replica.
        replicas: So many processes, each with its network.
        batch: At most so many pairs are matched together. A processor gains nothing by it: of two cores, a
            pair of 640x480 px takes 400, 390 and 405 ms by one, two and four.
        limits: What each replica accepts.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    model: str = "small"
    provider: str = "cpu"
    threads: Annotated[int, Field(ge=1)] = 1
    replicas: Annotated[int, Field(ge=1)] = 1
    batch: Annotated[int, Field(ge=1)] = 1
    limits: Limits = Limits()

    @property
    def gpus_each(self) -> int:
        """The GPUs that each replica has to itself."""
        return 1 if self.provider in GPU_PROVIDERS else 0


@serve.ingress()
class Replica:
    """A process of the service."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._matcher = Matcher(settings.model, threads=settings.threads, provider=settings.provider)
        self._free = asyncio.Event()
        self._free.set()
        self._together = serve.batch(
            max_batch_size=settings.batch, batch_wait_timeout_s=_GATHERED_WITHIN_S, batch_size_fn=self._size
        )(self._answered)

    def __serve_build_asgi_app__(self) -> Guard:
        limits = self._settings.limits
        return Guard(make_app(self._answering, limits, metrics), limits)

    async def _answering(self, order: Order, megapixels: float) -> Answer:
        """The answer to an order; what is cancelled while it waits is never begun."""
        # Else each that comes while another is matched would be a batch of its own.
        await self._free.wait()
        answer = await self._together((order, megapixels))
        if isinstance(answer, Exception):
            raise answer
        return answer

    async def _answered(self, waiting: list[tuple[Order, float]]) -> list[Answer | Exception]:
        self._free.clear()
        try:
            return await asyncio.to_thread(answer_many, self._matcher, [order for order, _ in waiting])
        finally:
            self._free.set()

    def _size(self, waiting: Sequence[tuple[Order, float]]) -> int:
        """How much of a batch they fill, counted in pairs."""
        most = self._settings.batch
        return sum(min(math.ceil(megapixels * most / _MEGAPIXELS_AT_ONCE), most) for _, megapixels in waiting)


def application(settings: Settings) -> serve.Application:
    """The service for `serve.run`, or for a Serve config file as stereoweave.service:application."""
    deployed = serve.deployment(
        name=NAME,
        num_replicas=settings.replicas,
        ray_actor_options={"num_cpus": settings.threads, "num_gpus": settings.gpus_each},
        max_ongoing_requests=settings.limits.waiting + _MOST_AT_DOOR,
        max_queued_requests=_MOST_AT_DOOR,
        graceful_shutdown_timeout_s=settings.limits.timeout_s,
        # What hinders a network once hinders it again.
        max_constructor_retry_count=2,
        logging_config=_QUIET,
    )
    return deployed(Replica).bind(settings)


def metrics() -> bytes:
    """What the exporters of Ray's nodes have of the service, in Prometheus' text format.

    They gather it every ten seconds. They also have what Ray and its Serve count of themselves.
    """
    merged: dict[str, Metric] = {}
    for family in (each for url in _exporters() for each in _exported(url)):
        known = merged.setdefault(family.name, family)
        known.samples += family.samples if known is not family else []
    registry = CollectorRegistry()
    registry.register(_Gathered(merged.values()))
    return generate_latest(registry)


def _exporters() -> Iterator[str]:
    for node in ray.nodes():  # type: ignore[no-untyped-call]
        if node["Alive"]:
            yield f"http://{node['NodeManagerAddress']}:{node['MetricsExportPort']}/metrics"


def _exported(url: str) -> Iterable[Metric]:
    """What an exporter has of the service; the rest is hundreds of times as much."""
    with urllib.request.urlopen(url, timeout=_METRICS_WITHIN_S) as response:
        lines = response.read().decode().splitlines()
    ours = [line for line in lines if re.match(rf"(# (HELP|TYPE) )?{_METRICS}", line)]
    return text_string_to_metric_families("\n".join([*ours, ""]))


@dataclass(frozen=True, eq=False)
class _Gathered(Collector):
    """Metrics that were counted elsewhere."""

    metrics: Iterable[Metric]

    def collect(self) -> Iterable[Metric]:
        return self.metrics


@contextmanager
def serving(settings: Settings, host: str, port: int, address: str | None = None) -> Iterator[None]:
    """The service, for as long as the block lasts; what it accepted is done before it ends.

    Args:
        settings: What it is made of.
        host: The address to serve.
        port: One that is free.
        address: As for `Engine`; a cluster that serves nothing yet.

    Raises:
        StereoweaveError: There is no room for all replicas, or Ray or the network is not as it should be.
    """
    address = address or os.environ.get("RAY_ADDRESS")
    engine = Engine(address, cpus_each=settings.threads, gpus_each=settings.gpus_each)
    if address is None:
        _check_room(settings, usable_cores() // settings.threads)
        Matcher(settings.model, provider=settings.provider)  # its errors come before Ray takes seconds
    logging.getLogger("ray.serve").setLevel(logging.CRITICAL)
    with connect(engine):
        _check_free(address)
        _check_room(settings, _room(engine))
        serve.start(http_options={"host": host, "port": port}, logging_config=_QUIET)
        try:
            _run(settings)
            yield
        finally:
            _end()
            if address:
                serve.shutdown()  # type: ignore[no-untyped-call]


def _check_free(address: str | None) -> None:
    """An error where a cluster serves already: its Serve listens where it does, and at no second port."""
    others = serve.status().applications
    if others:
        raise StereoweaveError(
            f"{address}: expected a cluster that serves nothing yet, found {', '.join(others)}; "
            "`serve shutdown` ends that, or add stereoweave.service:application to its Serve config file"
        )


def _run(settings: Settings) -> None:
    """Starts the replicas, and waits until their networks are loaded."""
    try:
        serve.run(application(settings), name=NAME, route_prefix="/")
    except RuntimeError as error:
        told = "\n".join(each.message for each in serve.status().applications[NAME].deployments.values())
        ours = re.findall(r"^stereoweave\.errors\.\w+: (.+)", told, re.MULTILINE)
        raise StereoweaveError(
            f"expected a network that loads where the service runs, found {(ours or [error])[-1]}; "
            "is the model there too?"
        ) from error


def _end() -> None:
    """Ends the replicas, each when what it accepted is done."""
    while NAME in serve.status().applications:
        with suppress(TimeoutError):  # it waits for a minute, and a request may take longer
            serve.delete(NAME)


def _check_room(settings: Settings, found: int) -> None:
    """An error where there is room for fewer replicas: Ray would wait for more, without a word."""
    if settings.replicas > found:
        gpu = " and a GPU" if settings.gpus_each else ""
        raise StereoweaveError(
            f"--replicas {settings.replicas} --threads {settings.threads}: expected at most {found}, for "
            f"which there is room, found {settings.replicas}; each takes {settings.threads} cores{gpu}"
        )


def _room(engine: Engine) -> int:
    """How many replicas the machines have room for."""
    try:
        return room(engine)
    except StereoweaveError:  # there is none: it names options of another command
        return 0
