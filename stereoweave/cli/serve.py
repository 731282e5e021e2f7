"""The command `stereoweave serve`."""

import math
import re
import signal
import socket
import threading
from pathlib import Path
from typing import Annotated

import typer

from stereoweave.cli.options import (
    Model,
    Port,
    Provider,
    find_allowed_hosts,
    format_url,
    listen,
)
from stereoweave.errors import StereoweaveError, reason, require_extra
from stereoweave.system.ray_engine import set_environment
from stereoweave.system.threads import usable_cores

Replicas = Annotated[int, typer.Option(min=1, help="Number of server processes; each loads the network.")]
Address = Annotated[
    str | None,
    typer.Option(
        help="Ray cluster to serve on, as host:port, or local to start Ray on this machine (default: "
        "RAY_ADDRESS if it is set, else local)."
    ),
]
Batch = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Maximum number of pairs matched together (default: 8 on a GPU; 1 on a CPU, where larger "
        "batches are not faster).",
    ),
]
Waiting = Annotated[
    int,
    typer.Option(
        min=1, help="Maximum number of pending requests per process; further ones get HTTP status 503."
    ),
]
MaxMegabytes = Annotated[
    float,
    typer.Option(min=0.001, help="Maximum size of a request in megabytes; larger ones get HTTP status 413."),
]
MaxMegapixels = Annotated[
    float,
    typer.Option(
        min=0.001,
        max=65,
        help="Maximum size of a view in megapixels; larger ones get HTTP status 413 and are not decoded.",
    ),
]
TimeoutS = Annotated[
    float,
    typer.Option(min=0.001, help="Time limit of a request in seconds; slower ones get HTTP status 504."),
]
BehindProxy = Annotated[
    bool,
    typer.Option(
        "--behind-proxy",
        help="Allow a --host that other machines can reach, because a proxy in front of the service "
        "(deploy/nginx.conf) checks the Host header.",
    ),
]
TokenFile = Annotated[
    Path | None,
    typer.Option(help="File with a bearer token that every request except /health must send."),
]
# Syntax of a bearer token in RFC 6750.
_TOKEN = r"[A-Za-z0-9\-._~+/]+=*"

ReplicaThreads = Annotated[
    int | None,
    typer.Option(
        "--threads", min=1, help="Number of CPU threads of each replica (default: a share of all cores)."
    ),
]
Host = Annotated[
    str,
    typer.Option(
        "--host",
        help="Address to listen on: 127.0.0.1 accepts only this computer; an address that other machines can "
        "reach needs --behind-proxy.",
    ),
]


def serve(  # noqa: PLR0913 - each is an option of the command line
    host: Host = "127.0.0.1",
    port: Port = 8000,
    model: Model = "small",
    provider: Provider = "cpu",
    replicas: Replicas = 1,
    threads: ReplicaThreads = None,
    address: Address = None,
    batch: Batch = None,
    waiting: Waiting = 8,
    max_megabytes: MaxMegabytes = 64,
    max_megapixels: MaxMegapixels = 25,
    timeout_s: TimeoutS = 60,
    behind_proxy: BehindProxy = False,
    token_file: TokenFile = None,
) -> None:
    """Serve depth and views over HTTP. Ctrl-C stops the service once accepted requests are answered."""
    set_environment(address)  # before the service imports Ray
    with require_extra("cluster", "the service needs Ray Serve"):
        from pydantic import SecretStr

        from stereoweave.service.asgi import Limits
        from stereoweave.service.deployment import GPU_PROVIDERS, Settings, run_service

    numbers = {
        "--max-megabytes": max_megabytes,
        "--max-megapixels": max_megapixels,
        "--timeout-s": timeout_s,
    }
    for option, number in numbers.items():
        if not math.isfinite(number):
            raise StereoweaveError(f"{option}: expected a finite number, found {number}")
    token = SecretStr(_read_token(token_file)) if token_file else None
    with listen(host, port) as listener:
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
        url = format_url(host, listener.getsockname()[1])
        with run_service(settings, listener, address):
            _wait_for_signal(f"Stereoweave: {url}, described by {url}/openapi.json; Ctrl-C stops it")


def _hosts(listener: socket.socket, host: str, behind_proxy: bool) -> tuple[str, ...] | None:
    """Return the values allowed in the Host header; None if a proxy checks the header."""
    if behind_proxy:
        return None
    names = find_allowed_hosts(listener, host)
    if names is None:
        raise StereoweaveError(
            f"--host {host}: expected a loopback address, such as 127.0.0.1, found one that other machines "
            "can reach; put a proxy in front of the service (deploy/nginx.conf) and add --behind-proxy"
        )
    return names


def _read_token(path: Path) -> str:
    """Read a token from a file, without surrounding white space."""
    try:
        token = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise StereoweaveError(
            f"--token-file {path}: expected a file with a token, found {reason(error)}"
        ) from error
    if not re.fullmatch(_TOKEN, token):
        found = "other characters" if token else "nothing"
        raise StereoweaveError(
            f"--token-file {path}: expected a token of letters, digits and -._~+/=, found {found}; "
            "make one with: openssl rand -hex 32"
        )
    return token


def _wait_for_signal(message: str) -> None:
    """Print the message, and wait for SIGINT or SIGTERM."""
    stopped = threading.Event()
    # The handlers are set here, because Ray installs its own when it starts.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())
    typer.echo(message)
    # Polling, because Python handles a signal that another thread receives only once this thread wakes up.
    while not stopped.wait(timeout=1):
        pass
