"""The command `stereoweave app`."""

from typing import Annotated

import typer

from stereoweave.cli.options import Port, Provider, find_allowed_hosts, format_url, listen
from stereoweave.errors import require_extra

Host = Annotated[
    str,
    typer.Option(
        help="Address to listen on: 127.0.0.1 accepts only this computer; 0.0.0.0 accepts any computer that "
        "can reach it, without encryption or password."
    ),
]
OpenBrowser = Annotated[bool, typer.Option("--open/--no-open", help="Open the page in the browser.")]


def app(
    host: Host = "127.0.0.1", port: Port = 7860, open_browser: OpenBrowser = False, provider: Provider = "cpu"
) -> None:
    """Serve a web page that shows depth and views of uploaded pairs.

    The page also makes 3-D pictures, shows point clouds, measures distances, converts stereo videos and
    offers all results for download.
    """
    from stereoweave.matching.providers import check_provider

    check_provider(provider)
    with listen(host, port) as listener:
        with require_extra("app", "the page needs Gradio"):
            from stereoweave.app.server import serve
        names = find_allowed_hosts(listener, host)
        url = format_url(_find_own_host(host), listener.getsockname()[1])
        typer.echo(f"Stereoweave: {url} (Ctrl-C stops it)")
        if names is None:
            typer.echo("The page has no password and no encryption, and other computers can reach it.")
        try:
            serve(listener, names, browsed=url if open_browser else None, provider=provider)
        except KeyboardInterrupt:
            raise typer.Exit(130) from None


def _find_own_host(host: str) -> str:
    """Return the host by which this computer reaches a listener: 0.0.0.0 and :: stand for all addresses."""
    return {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
