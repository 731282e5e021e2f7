"""The command stereoweave serve."""

import math
import re
import signal
import socket
import threading
from pathlib import Path
from typing import Annotated

import typer

from stereoweave.cli.options import Host, Model, Port, Provider, Threads, listening, own_names, url_at
from stereoweave.errors import StereoweaveError, needing_extra
from stereoweave.system.ray_engine import set_environment
from stereoweave.system.threads import usable_cores

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
BehindProxy = Annotated[
    bool,
    typer.Option(
        "--behind-proxy",
        help="Allow a --host that other machines reach: a proxy stands before it (deploy/nginx.conf), and "
        "checks the header Host.",
    ),
]
TokenFile = Annotated[
    Path | None,
    typer.Option(help="A file with a token that every request but /health has to show, as Bearer."),
]
# As RFC 6750 has it.
_TOKEN = r"[A-Za-z0-9\-._~+/]+=*"


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
    behind_proxy: BehindProxy = False,
    token_file: TokenFile = None,
) -> None:
    """Depth and views over HTTP, for other programs; Ctrl-C ends it when what it accepted is done."""
    set_environment(address)  # before the service imports Ray
    with needing_extra("cluster", "the service needs Ray Serve"):
        from pydantic import SecretStr

        from stereoweave.service.asgi import Limits
        from stereoweave.service.deployment import GPU_PROVIDERS, Settings, serving

    numbers = {
        "--max-megabytes": max_megabytes,
        "--max-megapixels": max_megapixels,
        "--timeout-s": timeout_s,
    }
    for option, number in numbers.items():
        if not math.isfinite(number):
            raise StereoweaveError(f"{option}: expected a finite number, found {number}")
    token = SecretStr(_read_token(token_file)) if token_file else None
    with listening(host, port) as listener:
        limits = Limits(
            megabytes=max_megabytes,
            megapixels=max_megapixels,
            timeout_s=timeout_s,
            waiting=waiting,
            hosts=_hosts(listener, host, behind_proxy),
            token=token,
        )
        settings = Settings(
            model=model,
            provider=provider,
            threads=threads or max(1, usable_cores() // replicas),
            replicas=replicas,
            batch=batch or (8 if provider in GPU_PROVIDERS else 1),
            limits=limits,
        )
        url = url_at(host, listener.getsockname()[1])
        with serving(settings, listener, address):
            _wait_for_signal(f"Stereoweave: {url}, described by {url}/openapi.json; Ctrl-C ends it")


def _hosts(listener: socket.socket, host: str, behind_proxy: bool) -> tuple[str, ...] | None:
    """The names that requests may give this machine; None where a proxy checks them."""
    if behind_proxy:
        return None
    names = own_names(listener, host)
    if names is None:
        raise StereoweaveError(
            f"--host {host}: expected an address of this machine alone, such as 127.0.0.1, found one that "
            "others reach; put a proxy before the service (deploy/nginx.conf) and add --behind-proxy"
        )
    return names


def _read_token(path: Path) -> str:
    """The token in a file, without the white space around it."""
    try:
        token = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise StereoweaveError(f"--token-file {path}: expected a file with a token, found {error}") from error
    if not re.fullmatch(_TOKEN, token):
        found = "other characters" if token else "nothing"
        raise StereoweaveError(
            f"--token-file {path}: expected a token of letters, digits and -._~+/=, found {found}; "
            "make one with: openssl rand -hex 32"
        )
    return token


def _wait_for_signal(message: str) -> None:
    """Print the message and return at SIGINT or SIGTERM."""
    stopped = threading.Event()
    # Here, because Ray brings handlers of its own.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())
    typer.echo(message)
    # Again and again: a signal that another thread receives is handled when this one is awake.
    while not stopped.wait(timeout=1):
        pass
