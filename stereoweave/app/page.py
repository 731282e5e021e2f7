"""The web page, of Gradio: a pair becomes depth, views under a slider, a point cloud, distances and files."""

import html
import importlib.resources
import os
import re
import shutil
import signal
import socket
import sys
import tempfile
import webbrowser
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any
from uuid import uuid4

import gradio as gr
import uvicorn
from fastapi import FastAPI
from starlette.middleware.trustedhost import TrustedHostMiddleware

from stereoweave.app.access import ContentPolicy, OwnFiles
from stereoweave.app.session import (
    Kept,
    Uploads,
    depth_picture,
    ends,
    marked,
    matched,
    measured,
    numbers,
    write_all,
    write_cloud,
    zipped,
)
from stereoweave.errors import Note, StereoweaveError, worded
from stereoweave.io.colormap import OCCLUDED_RGB, colour_confidence, css_colour, legend_colours
from stereoweave.matching.backend import Backend
from stereoweave.matching.providers import CPU
from stereoweave.pictures.loading import FORMATS
from stereoweave.pictures.prepare import Request

_MOST_BYTES = 200 * 1024**2

_KEPT_S = 3600
# Each keeps its last result: 60 MB, and 19 bytes a pixel of the left picture, 0.5 GB of 24 megapixels; and
# on disk its files, 0.9 GB of so many.
_MOST_SESSIONS = 4
_GUESSED = "guessed"
_MODELS = [("fast", "small"), ("fine", "base")]

_HEAD = """<div class="head"><h1>Stereoweave</h1>
<p>Two photographs of one scene become depth, and the view from anywhere between the two cameras.
The pictures stay on the computer that runs this page.</p></div>"""
_EMPTY = """<div class="empty"><ol>
<li>Drop the left and the right picture, or one file that holds both:
side by side, one above the other, MPO or JPS.</li>
<li>Press <b>Find depth</b>. Pictures straight from two cameras need their rows brought to match first.</li>
<li>Move between the cameras, turn the point cloud, measure, and take the files with you.</li>
</ol></div>"""
_TO_MEASURE = "Click two points of the photograph: here stands how far each is, and how far apart they are."
_WITHOUT_WEBGL = """const canvas = document.createElement("canvas");
if (!canvas.getContext("webgl2") && !canvas.getContext("webgl")) element.innerHTML =
  '<p class="told problem">This browser does not draw in three dimensions: switch on its hardware ' +
  'acceleration (WebGL). Where metres are known, another program shows cloud.glb, under Files.</p>';"""
_GONE = "This result has been put away, as after an hour. Find depth again."


class Page:
    """The page's parts, and what each does; `folder` takes the files to download, for an hour."""

    def __init__(self, folder: Path, provider: str = CPU) -> None:
        self._folder, self._provider = folder, provider
        with gr.Blocks(
            title="Stereoweave", analytics_enabled=False, delete_cache=(_KEPT_S // 4, _KEPT_S)
        ) as self.blocks:
            self._kept = gr.State(None, time_to_live=_KEPT_S, delete_callback=_put_away)
            self._clicks = gr.State([])
            gr.HTML(_HEAD, padding=False)
            with gr.Row():
                with gr.Column(scale=1, min_width=280):
                    self._ask()
                with gr.Column(scale=3, min_width=280):
                    self._status = gr.HTML(_EMPTY, elem_id="status", padding=False)
                    with gr.Column(visible=False) as self._results:
                        self._show()
            self._connect()
        self.blocks.state_session_capacity = _MOST_SESSIONS
        self.blocks.queue(default_concurrency_limit=1)

    def _ask(self) -> None:
        """The part that takes pictures."""
        self._left = gr.File(label="Left picture, or one file with both views", height=160, elem_id="left")
        self._right = gr.File(label="Right picture", height=160, elem_id="right")
        self._model = gr.Radio(_MODELS, value="small", label="Network", elem_id="model")
        self._rectify = gr.Checkbox(
            label="Bring the rows to match",
            info="For pictures straight from two cameras. Those of a 3-D film or data set match as they are.",
            elem_id="rectify",
        )
        with gr.Accordion("More about the pictures", open=False):
            self._arrangement = gr.Dropdown(
                [_GUESSED, *((name.replace("_", " "), name) for name in FORMATS)],
                value=_GUESSED,
                label="How one file holds both",
                elem_id="arrangement",
            )
            self._calibration = gr.File(
                label="Calibration file, for metres", height=140, elem_id="calibration"
            )
            with gr.Row():
                self._focal_px = _known_number("Focal length, px", "focal")
                self._baseline_mm = _known_number("Baseline, mm", "baseline")
        self._find = gr.Button("Find depth", variant="primary", elem_id="find")
        self._sample = gr.Button("Try the sample", elem_id="sample")

    def _show(self) -> None:
        """The part that shows results."""
        with gr.Tabs() as self._tabs:
            with gr.Tab("View and depth", id="first"):
                self._view = _picture("New view", "view")
                self._position = gr.Slider(
                    -0.5,
                    1.5,
                    value=0.5,
                    step=0.05,
                    label="Viewpoint",
                    info="0 is the left camera, 1 the right one",
                    buttons=[],
                    elem_id="position",
                )
                self._where = gr.HTML(elem_id="where")
                with gr.Row():
                    with gr.Column(min_width=280):
                        self._depth = _picture("Depth", "depth")
                        self._ramp = gr.HTML()
                    with gr.Column(min_width=280):
                        self._confidence = _picture("Confidence", "confidence")
                        gr.HTML(_confidence_legend())
            with gr.Tab("Measure"):
                self._measured = gr.HTML(elem_id="measured")
                self._photograph = _picture("Left photograph", "photograph")
            with gr.Tab("Point cloud") as self._cloud_tab:
                gr.HTML(js_on_load=_WITHOUT_WEBGL, padding=False)
                self._cloud = gr.Model3D(
                    label="Drag to turn, scroll to come nearer",
                    clear_color=(0.94, 0.95, 0.96, 1.0),
                    height=560,
                )
            with gr.Tab("Files"):
                self._all = gr.DownloadButton("Download all (zip)", variant="primary", elem_id="all")
                self._files = gr.File(label="One at a time", interactive=False, elem_id="files")

    def _connect(self) -> None:
        """What happens on which event."""
        asked = [self._left, self._right, self._model, self._rectify, self._arrangement, self._calibration]
        asked += [self._focal_px, self._baseline_mm]
        seen = [self._results, self._kept, self._view, self._where, self._depth, self._ramp]
        seen += [self._confidence, self._photograph, self._clicks, self._measured]
        seen += [self._tabs, self._cloud]
        taken = [self._status, self._files, self._all]
        sampled = self._sample.click(self._sampled, None, asked, api_visibility="private")
        for begin in (self._find.click, sampled.then):
            found = begin(
                self._found,
                {*asked, self._position, self._kept},
                [*taken, *seen],
                show_progress_on=self._status,
                concurrency_id="matching",
                api_visibility="private",
            )
            found.then(
                self._written,
                self._kept,
                taken,
                show_progress_on=self._status,
                concurrency_id="matching",
                api_visibility="private",
            )
        self._position.input(
            self._seen,
            [self._kept, self._position],
            [self._view, self._where],
            show_progress="hidden",
            trigger_mode="always_last",
            concurrency_limit=None,
            api_visibility="private",
        )
        # When its tab is opened, and under a new name each time: Gradio's viewer stays empty where its value
        # comes before it is shown, or comes twice.
        self._cloud_tab.select(
            self._turned, self._kept, self._cloud, concurrency_id="matching", api_visibility="private"
        )
        self._photograph.select(
            self._clicked,
            [self._kept, self._clicks],
            [self._photograph, self._measured, self._clicks],
            show_progress="hidden",
            trigger_mode="multiple",
            concurrency_limit=None,
            api_visibility="private",
        )

    def _sampled(self) -> dict[Any, Any]:
        """The form filled in with the pair that the package brings."""
        folder = _sample_folder()
        return {
            self._left: str(folder / "left.jpg"),
            self._right: str(folder / "right.jpg"),
            self._calibration: str(folder / "calib.txt"),
            self._model: "small",
            self._rectify: False,
            self._arrangement: _GUESSED,
            self._focal_px: 0,
            self._baseline_mm: 0,
        }

    def _found(self, given: dict[Any, Any], progress: Any = gr.Progress()) -> dict[Any, Any]:  # noqa: B008
        """What the page shows of the pictures that were given, or what is wrong with them."""
        _put_away(given[self._kept])
        try:
            uploads, folder = self._uploads(given), Path(tempfile.mkdtemp(dir=self._folder))
            return self._shown(matched(uploads, folder, partial(_tell, progress)), given[self._position])
        except (StereoweaveError, OSError) as error:
            return {
                self._status: _told([self._shown_line(worded(error, self._label_of))], problem=True),
                self._results: gr.update(visible=False),
                self._kept: None,
            }

    def _label_of(self, setting: str) -> str | None:
        """The page's label of a setting; None if the page does not have it."""
        components = {
            "arrangement": self._arrangement,
            "baseline_m": self._baseline_mm,
            "calibration": self._calibration,
            "focal_px": self._focal_px,
            "model": self._model,
            "rectify": self._rectify,
        }
        return f"“{components[setting].label}”" if setting in components else None

    def _shown_line(self, line: str) -> str:
        """A message in one line, without this machine's folders."""
        return re.sub(rf"{re.escape(str(self._folder))}/\w+/", "", " ".join(line.splitlines()))

    def _written(self, kept: Kept | None, progress: Any = gr.Progress()) -> dict[Any, Any]:  # noqa: B008
        """The files, which take as long again as all that was shown."""
        if kept is None:
            return {self._files: None}
        _tell(progress, 0.8, "writing the files")
        try:
            files, notes = write_all(kept)
            packed = zipped(kept.folder / "stereoweave.zip", files)
        except (StereoweaveError, OSError) as error:
            return {self._status: _told([self._shown_line(worded(error, self._label_of))], problem=True)}
        return {
            self._status: self._summary(kept, notes),
            self._files: [str(file) for file in files],
            self._all: gr.update(value=packed and str(packed), visible=packed is not None),
        }

    def _summary(self, kept: Kept, notes: Sequence[Note] = ()) -> str:
        lines = [self._shown_line(note.worded(self._label_of)) for note in (*kept.result.notes, *notes)]
        return _told([numbers(kept.result.summary), *lines])

    def _uploads(self, given: dict[Any, Any]) -> Uploads:
        arrangement, calibration = given[self._arrangement], given[self._calibration]
        focal_px, baseline_mm = given[self._focal_px] or None, given[self._baseline_mm] or None
        request = Request(
            arrangement=None if arrangement == _GUESSED else arrangement,
            calibration=Path(calibration) if calibration else None,
            focal_px=focal_px,
            baseline_m=baseline_mm and baseline_mm / 1000,
            rectify=given[self._rectify],
        )
        pictures = tuple(Path(file) for file in (given[self._left], given[self._right]) if file)
        backend = Backend(model=given[self._model], provider=self._provider)
        return Uploads(pictures=pictures, request=request, backend=backend)

    def _shown(self, kept: Kept, position: float) -> dict[Any, Any]:
        pair, estimate = kept.renderer.pair, kept.renderer.estimate
        view, where = self._seen(kept, position)
        return {
            self._status: self._summary(kept),
            self._results: gr.update(visible=True),
            self._kept: kept,
            self._view: view,
            self._where: where,
            self._depth: depth_picture(kept),
            self._ramp: _depth_legend(kept),
            self._confidence: colour_confidence(estimate.confidence, estimate.occluded),
            self._photograph: pair.left,
            self._clicks: [],
            self._tabs: gr.update(selected="first"),
            self._measured: _paragraphs([_TO_MEASURE]),
            self._cloud: None,
            self._files: None,
            self._all: gr.update(value=None, visible=False),
        }

    def _seen(self, kept: Kept | None, position: float) -> tuple[Any, str]:
        """The view from a position, and a line about it."""
        if kept is None:
            return gr.skip(), _GONE
        view = kept.renderer.view(position)
        unseen = f"{100 * (~view.drawn).mean():.1f} % of it seen by neither camera"
        return view.image, f"{position:g}, {_place(position)}; {unseen}"

    def _turned(self, kept: Kept | None) -> str | None:
        """The file of the point cloud."""
        cloud = kept and write_cloud(kept.folder / f"{uuid4().hex}.glb", kept.result)
        return str(cloud) if cloud else None

    def _clicked(
        self, kept: Kept | None, clicks: list[tuple[int, int]], event: gr.SelectData
    ) -> tuple[Any, str, list[tuple[int, int]]]:
        """The photograph with the points clicked so far, at most two, and what was measured there."""
        if kept is None:
            return gr.skip(), _paragraphs([_GONE]), []
        column, row = event.index
        clicks = [*(clicks if len(clicks) < 2 else []), (int(column), int(row))]
        return marked(kept.renderer.pair.left, clicks), _paragraphs(measured(kept, clicks)), clicks


def _put_away(kept: Kept | None) -> None:
    """Removes the files of a result that is no longer shown."""
    if kept:
        shutil.rmtree(kept.folder, ignore_errors=True)


def _tell(progress: Any, share: float, what: str) -> None:
    progress(share, desc=what)


def _known_number(label: str, name: str) -> gr.Number:
    return gr.Number(0, label=label, info="0: not known", min_width=120, elem_id=name)


def _picture(label: str, name: str) -> gr.Image:
    return gr.Image(
        label=label, format="jpeg", interactive=False, buttons=["fullscreen"], elem_id=name, alt_text=label
    )


def _told(lines: Sequence[str], *, problem: bool = False) -> str:
    """Lines as the page shows them, one below the other; a problem stands out and is read out."""
    look, role = ("told problem", "alert") if problem else ("told", "status")
    return f'<div class="{look}" role="{role}">{_paragraphs(lines)}</div>'


def _paragraphs(lines: Sequence[str]) -> str:
    return "".join(f"<p>{html.escape(line)}</p>" for line in lines)


def _depth_legend(kept: Kept) -> str:
    far, near = ends(kept.result)
    return _legend(f"linear-gradient(90deg,{','.join(legend_colours(24))})", f"far: {far}", f"near: {near}")


def _confidence_legend() -> str:
    key = f'<i class="key" style="background:{css_colour(OCCLUDED_RGB)}"></i>seen by the left camera alone'
    return _legend("linear-gradient(90deg,#000,#fff)", "unsure", key, "sure")


def _legend(colours: str, *labels: str) -> str:
    spans = "".join(f"<span>{label}</span>" for label in labels)
    return f'<div class="ramp" style="background:{colours}"></div><div class="ends">{spans}</div>'


def _place(position: float) -> str:
    """In words where a view is seen from."""
    if position in (0, 1):
        return "the right picture itself" if position else "the left picture itself"
    if position < 0:
        return "left of the left camera"
    return "right of the right camera" if position > 1 else "between the cameras"


def _sample_folder() -> Path:
    return Path(str(importlib.resources.files("stereoweave"))) / "sample"


def make_server(folder: Path, names: Sequence[str] | None, provider: str = CPU) -> FastAPI:
    """The page as an ASGI application; uploads and results lie in a folder of its own.

    It answers to `names` alone, or to any name where that is None.
    """
    os.environ["GRADIO_TEMP_DIR"] = str(folder)
    server = FastAPI(openapi_url=None)
    css = importlib.resources.files("stereoweave.app").joinpath("page.css").read_text(encoding="utf-8")
    gr.mount_gradio_app(
        server,
        Page(folder, provider).blocks,
        path="/",
        footer_links=[],
        run_history=False,
        allowed_paths=[str(_sample_folder())],
        max_file_size=_MOST_BYTES,
        show_error=False,
        ssr_mode=False,
        pwa=False,
        mcp_server=False,
        theme=_theme(),
        css=css,
    )
    server.add_middleware(OwnFiles)
    if names is not None:
        server.add_middleware(TrustedHostMiddleware, allowed_hosts=names, www_redirect=False)
    server.add_middleware(ContentPolicy)
    return server


def _theme() -> gr.themes.Base:
    """Calm, and with the fonts that the visitor's computer has."""
    return gr.themes.Base(
        primary_hue="blue",
        neutral_hue="slate",
        radius_size="lg",
        font=["system-ui", "Segoe UI", "Roboto", "Helvetica Neue", "Arial", "sans-serif"],
        font_mono=["ui-monospace", "Consolas", "monospace"],
    ).set(body_text_color_subdued="*neutral_600", body_text_color_subdued_dark="*neutral_300")


def serve(
    listener: socket.socket, names: Sequence[str] | None, *, browsed: str | None = None, provider: str = CPU
) -> None:
    """Serves the page on a listening socket until a signal ends it; then what was uploaded is removed.

    The page answers to `names`, as of `make_server`; `browsed` is the URL that a browser opens, if any.
    """
    _end_in_order()
    with tempfile.TemporaryDirectory(prefix="stereoweave-page-") as folder:
        # An open page keeps a connection open, which would never end of itself.
        server = make_server(Path(folder), names, provider)
        config = uvicorn.Config(server, log_level="critical", timeout_graceful_shutdown=1)
        if browsed:
            webbrowser.open(browsed)
        uvicorn.Server(config).run(sockets=[listener])


def _end_in_order() -> None:
    """Lets SIGTERM, and the end of the terminal, end the process by an exception, as Ctrl-C does."""
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    hang_up = getattr(signal, "SIGHUP", None)  # Windows has none
    # Whoever has it ignored, such as nohup, is obeyed. An exception in the midst of Uvicorn's loop may hang:
    # SIGTERM ends the loop first.
    if hang_up and signal.getsignal(hang_up) is signal.SIG_DFL:
        signal.signal(hang_up, lambda *_: signal.raise_signal(signal.SIGTERM))
