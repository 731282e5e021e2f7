"""The command stereoweave serve."""

import math
import signal
import threading
from typing import Annotated

import typer

from stereoweave.command_line import Host, Model, Port, Provider, Threads, listening, url_at
from stereoweave.engine import set_environment
from stereoweave.errors import StereoweaveError, needing_extra
from stereoweave.threads import usable_cores

Replicas = Annotated[int, typer.Option(min=1, help="Processes, each with a network of its own.")]
Address = Annotated[
    str | None,
    typer.Option(help="A Ray cluster to serve on, as host:port; Ray is started here unless given."),
]
Batch = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Pairs that are matched together at most; 8 on a GPU unless given, and 1 on a processor, which "
        "gains nothing by more.",
    ),
]
Waiting = Annotated[
    int, typer.Option(min=1, help="Requests that a process accepts at a time; more are refused with 503.")
]
MaxMegabytes = Annotated[float, typer.Option(min=0.001, help="Of a request; larger ones get 413.")]
MaxMegapixels = Annotated[
    float, typer.Option(min=0.001, max=65, help="Of a view; larger ones get 413, and are not decoded.")
]
TimeoutS = Annotated[float, typer.Option(min=0.001, help="For a request, in seconds; then it gets 504.")]


def serve(  # noqa: PLR0913 - each is a word of the command line
    host: Host = "127.0.0.1",
    port: Port = 8000,
    model: Model = "small",
    provider: Provider = "cpu",
    replicas: Replicas = 1,
    threads: Threads = None,
    address: Address = None,
    batch: Batch = None,
    waiting: Waiting = 8,
    max_megabytes: MaxMegabytes = 64,
    max_megapixels: MaxMegapixels = 25,
    timeout_s: TimeoutS = 60,
) -> None:
    """Depth and views over HTTP, for other programs; Ctrl-C ends it when what it accepted is done."""
    set_environment(address)  # before the service imports Ray
    with needing_extra("cluster", "the service needs Ray Serve"):
        from stereoweave.service import GPU_PROVIDERS, Settings, serving
        from stereoweave.service_http import Limits

    numbers = {
        "--max-megabytes": max_megabytes,
        "--max-megapixels": max_megapixels,
        "--timeout-s": timeout_s,
    }
    for option, number in numbers.items():
        if not math.isfinite(number):
            raise StereoweaveError(f"{option}: expected a finite number, found {number}")
    limits = Limits(megabytes=max_megabytes, megapixels=max_megapixels, timeout_s=timeout_s, waiting=waiting)
    settings = Settings(
        model=model,
        provider=provider,
        threads=threads or max(1, usable_cores() // replicas),
        replicas=replicas,
        batch=batch or (8 if provider in GPU_PROVIDERS else 1),
        limits=limits,
    )
    with listening(host, port) as listener:
        port = listener.getsockname()[1]
    with serving(settings, host, port, address):
        stopped = threading.Event()
        # Here, because Ray brings handlers of its own.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stopped.set())
        url = url_at(host, port)
        typer.echo(f"Stereoweave: {url}, described by {url}/openapi.json; Ctrl-C ends it")
        # Again and again: a signal that another thread receives is handled when this one is awake.
        while not stopped.wait(timeout=1):
            pass
