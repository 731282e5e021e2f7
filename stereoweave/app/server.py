"""Web server for the page, with limits, allowed hosts and signal handling."""

import importlib.resources
import os
import signal
import socket
import sys
import tempfile
import webbrowser
from collections.abc import Sequence
from pathlib import Path

import gradio as gr
import uvicorn
from fastapi import FastAPI
from starlette.middleware.trustedhost import TrustedHostMiddleware

from stereoweave.app.access import ContentPolicy, OwnFiles
from stereoweave.app.events import Host
from stereoweave.app.page import make_page
from stereoweave.app.streams import EndedStreams
from stereoweave.app.workers import Workers
from stereoweave.matching.providers import CPU
from stereoweave.pictures.sample import sample_folder

_MOST_BYTES = 200 * 1024**2
# Gradio applies our style sheet only inside this margin.
_NARROW = "<style>@media (max-width: 640px) { .gradio-container .main { padding: 1rem !important } }</style>"


def make_server(host: Host, names: Sequence[str] | None) -> FastAPI:
    """Make the page's ASGI application.

    Args:
        host: Folder for uploads and results, processes for the work, and provider.
        names: Allowed values of the Host header; None allows all values.
    """
    os.environ["GRADIO_TEMP_DIR"] = str(host.folder)
    server = FastAPI(openapi_url=None)
    css = importlib.resources.files("stereoweave.app").joinpath("page.css").read_text(encoding="utf-8")
    gr.mount_gradio_app(
        server,
        make_page(host),
        path="/",
        footer_links=[],
        run_history=False,
        allowed_paths=[str(sample_folder())],
        max_file_size=_MOST_BYTES,
        show_error=False,
        ssr_mode=False,
        pwa=False,
        mcp_server=False,
        theme=_make_theme(),
        css=css,
        head=_NARROW,
    )
    server.add_middleware(OwnFiles)
    server.add_middleware(EndedStreams)
    if names is not None:
        server.add_middleware(TrustedHostMiddleware, allowed_hosts=names, www_redirect=False)
    server.add_middleware(ContentPolicy)
    return server


def _make_theme() -> gr.themes.Base:
    """Return a plain theme that uses fonts installed on the visitor's computer."""
    return gr.themes.Base(
        primary_hue="blue",
        neutral_hue="slate",
        radius_size="lg",
        font=["system-ui", "Segoe UI", "Roboto", "Helvetica Neue", "Arial", "sans-serif"],
        font_mono=["ui-monospace", "Consolas", "monospace"],
    ).set(
        body_text_color_subdued="*neutral_600",
        body_text_color_subdued_dark="*neutral_300",
        # Blue 500 has a contrast of 3.7 with white; 4.5 is needed for text of this size.
        button_primary_background_fill="*primary_600",
        button_primary_background_fill_hover="*primary_700",
        color_accent="*primary_600",
    )


def serve(
    listener: socket.socket, names: Sequence[str] | None, *, browsed: str | None = None, provider: str = CPU
) -> None:
    """Serve the page on a listening socket until a signal arrives, then remove all uploads.

    Args:
        listener: The listening socket.
        names: Allowed values of the Host header; None allows all values.
        browsed: URL to open in a browser; if None, no browser is opened.
        provider: Hardware that runs the network.
    """
    _handle_signals()
    with (
        tempfile.TemporaryDirectory(prefix="stereoweave-page-") as folder,
        Workers(Path(folder) / "workers") as workers,
    ):
        server = make_server(Host(Path(folder), workers, provider), names)
        # An open page keeps its connection open, so the shutdown has a time limit.
        config = uvicorn.Config(server, log_level="critical", timeout_graceful_shutdown=1)
        if browsed:
            webbrowser.open(browsed)
        uvicorn.Server(config).run(sockets=[listener])


def _handle_signals() -> None:
    """Make SIGTERM and SIGHUP raise an exception that ends the process, as Ctrl-C does."""
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    hang_up = getattr(signal, "SIGHUP", None)  # missing on Windows
    # An ignored SIGHUP, as under nohup, stays ignored. An exception inside Uvicorn's loop may make the
    # loop hang, so SIGHUP raises SIGTERM, which stops the loop first.
    if hang_up and signal.getsignal(hang_up) is signal.SIG_DFL:
        signal.signal(hang_up, lambda *_: signal.raise_signal(signal.SIGTERM))
