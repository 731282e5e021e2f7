"""The commands that open a window on results: stereoweave app."""

import socket
from typing import Annotated

import typer

from stereoweave.command_line import Provider
from stereoweave.errors import StereoweaveError, needing_extra

Host = Annotated[
    str,
    typer.Option(
        help="The address to serve. 127.0.0.1 is this computer alone; 0.0.0.0 is everyone in its networks."
    ),
]
Port = Annotated[int, typer.Option(min=0, max=65535, help="0 takes any that is free.")]
OpenBrowser = Annotated[bool, typer.Option("--open/--no-open", help="Open the page in the browser.")]


def app(
    host: Host = "127.0.0.1", port: Port = 7860, open_browser: OpenBrowser = False, provider: Provider = "cpu"
) -> None:
    """A web page: drop a pair, see depth and views, turn the point cloud, measure, download."""
    from stereoweave.providers import check_provider

    check_provider(provider)
    with _listening(host, port) as listener:
        with needing_extra("app", "the page needs Gradio"):
            from stereoweave.app import serve
        shown = f"[{host}]" if ":" in host else host
        url = f"http://{shown}:{listener.getsockname()[1]}"
        typer.echo(f"Stereoweave: {url} (Ctrl-C ends it)")
        try:
            serve(listener, url, open_browser=open_browser, provider=provider)
        except KeyboardInterrupt:
            raise typer.Exit(130) from None


def _listening(host: str, port: int) -> socket.socket:
    """A socket that listens there; an error in one line where that cannot be."""
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        return socket.create_server(address[:2], family=family)
    except OSError as error:
        raise StereoweaveError(
            f"--host {host} --port {port}: expected an address that is free, found {str(error).lower()}; "
            "--port 0 takes any port that is free"
        ) from error
