"""The command `stereoweave app`."""

from typing import Annotated

import typer

from stereoweave.cli.options import Host, Port, Provider, find_allowed_hosts, format_url, listen
from stereoweave.errors import require_extra

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
        url = format_url(host, listener.getsockname()[1])
        typer.echo(f"Stereoweave: {url} (Ctrl-C stops it)")
        try:
            names, browsed = find_allowed_hosts(listener, host), url if open_browser else None
            serve(listener, names, browsed=browsed, provider=provider)
        except KeyboardInterrupt:
            raise typer.Exit(130) from None
