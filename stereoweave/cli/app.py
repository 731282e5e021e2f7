"""The commands that open a window on results: stereoweave app."""

from typing import Annotated

import typer

from stereoweave.cli.options import Host, Port, Provider, listening, own_names, url_at
from stereoweave.errors import needing_extra

OpenBrowser = Annotated[bool, typer.Option("--open/--no-open", help="Open the page in the browser.")]


def app(
    host: Host = "127.0.0.1", port: Port = 7860, open_browser: OpenBrowser = False, provider: Provider = "cpu"
) -> None:
    """A web page: drop a pair, see depth and views, turn the point cloud, measure, download."""
    from stereoweave.matching.providers import check_provider

    check_provider(provider)
    with listening(host, port) as listener:
        with needing_extra("app", "the page needs Gradio"):
            from stereoweave.app.page import serve
        url = url_at(host, listener.getsockname()[1])
        typer.echo(f"Stereoweave: {url} (Ctrl-C ends it)")
        try:
            names, browsed = own_names(listener, host), url if open_browser else None
            serve(listener, names, browsed=browsed, provider=provider)
        except KeyboardInterrupt:
            raise typer.Exit(130) from None
