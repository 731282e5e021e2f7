"""The Gradio web page, which shows the depth of an uploaded pair.

The page also has a slider to move the viewpoint, a point cloud, distance measurement and downloads.
"""

import html
import re
import shutil
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any
from uuid import uuid4

import gradio as gr

from stereoweave.app.session import (
    Session,
    Uploads,
    colour_depth,
    format_colour_range,
    format_summary,
    mark_clicks,
    match_uploads,
    measure_clicks,
    write_all,
    write_cloud,
    zip_files,
)
from stereoweave.errors import Note, StereoweaveError, format_error
from stereoweave.io.colormap import OCCLUDED_RGB, colour_confidence, css_colour, legend_colours
from stereoweave.matching.backend import Backend
from stereoweave.matching.providers import CPU
from stereoweave.pictures.loading import FORMATS
from stereoweave.pictures.prepare import Request
from stereoweave.pictures.sample import sample_folder

_LIFETIME_S = 3600
# Each session keeps its last result. It takes 60 MB plus 19 bytes per pixel of the left picture in memory
# (0.5 GB at 24 megapixels), and the size of its files on disk (0.9 GB at 24 megapixels).
_MOST_SESSIONS = 4
_DETECTED = "detected"
_MODELS = [("fast", "small"), ("fine", "base")]

# Labels of the form's fields, by setting.
_LABELS = {
    "format": "Layout of a single file",
    "baseline_m": "Baseline, mm",
    "calibration": "Calibration file, for metres",
    "focal_px": "Focal length, px",
    "model": "Network",
    "rectify": "Rectify the pair",
}

_HEAD = """<div class="head"><h1>Stereoweave</h1>
<p>Two pictures of one scene become depth, and the view from anywhere between the two cameras.
The pictures stay on the computer that runs this page.</p></div>"""
_EMPTY = """<div class="empty"><ol>
<li>Drop the left and the right picture, or one file that holds both:
side by side, one above the other, MPO or JPS.</li>
<li>Press <b>Find depth</b>. Pictures straight from two cameras must be rectified first: tick the box.</li>
<li>Move between the cameras, rotate the point cloud, measure, and download the files.</li>
</ol></div>"""
_TO_MEASURE = "Click two points in the left picture to see their depths and the distance between them here."
_WITHOUT_WEBGL = """const canvas = document.createElement("canvas");
if (!canvas.getContext("webgl2") && !canvas.getContext("webgl")) element.innerHTML =
  '<p class="notice problem">This browser cannot draw in 3-D: turn on its hardware acceleration ' +
  '(WebGL). If metres are known, open cloud.glb, under Files, in another program.</p>';"""
_GONE = "This result has expired (results are kept for an hour). Find depth again."


def label_of(setting: str) -> str | None:
    """Return the page's label for a setting; None if the page does not have that setting."""
    return f"“{_LABELS[setting]}”" if setting in _LABELS else None


class Page:
    """The page's components and event handlers; files to download are kept in `folder` for an hour."""

    def __init__(self, folder: Path, provider: str = CPU) -> None:
        self._folder, self._provider = folder, provider
        with gr.Blocks(
            title="Stereoweave", analytics_enabled=False, delete_cache=(_LIFETIME_S // 4, _LIFETIME_S)
        ) as self.blocks:
            self._session = gr.State(None, time_to_live=_LIFETIME_S, delete_callback=_remove_files)
            self._clicks = gr.State([])
            gr.HTML(_HEAD, padding=False)
            with gr.Row():
                with gr.Column(scale=1, min_width=280):
                    self._build_form()
                with gr.Column(scale=3, min_width=280):
                    self._status = gr.HTML(_EMPTY, elem_id="status", padding=False)
                    with gr.Column(visible=False) as self._results:
                        self._build_results()
            self._connect()
        self.blocks.state_session_capacity = _MOST_SESSIONS
        self.blocks.queue(default_concurrency_limit=1)

    def _build_form(self) -> None:
        """Build the form for pictures and settings."""
        self._left = gr.File(label="Left picture, or one file with both views", height=160, elem_id="left")
        self._right = gr.File(label="Right picture", height=160, elem_id="right")
        self._model = gr.Radio(_MODELS, value="small", label=_LABELS["model"], elem_id="model")
        self._rectify = gr.Checkbox(
            label=_LABELS["rectify"],
            info="For pictures straight from two cameras. 3-D films and data sets are already rectified.",
            elem_id="rectify",
        )
        with gr.Accordion("More about the pictures", open=False):
            self._layout = gr.Dropdown(
                [_DETECTED, *((name.replace("_", " "), name) for name in FORMATS)],
                value=_DETECTED,
                label=_LABELS["format"],
                elem_id="layout",
            )
            self._calibration = gr.File(label=_LABELS["calibration"], height=140, elem_id="calibration")
            with gr.Row():
                self._focal_px = _make_optional_number(_LABELS["focal_px"], "focal")
                self._baseline_mm = _make_optional_number(_LABELS["baseline_m"], "baseline")
        self._find = gr.Button("Find depth", variant="primary", elem_id="find")
        self._sample = gr.Button("Try the sample", elem_id="sample")

    def _build_results(self) -> None:
        """Build the part of the page that shows results."""
        with gr.Tabs() as self._tabs:
            with gr.Tab("View and depth", id="first"):
                self._view = _make_picture("New view", "view")
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
                        self._depth = _make_picture("Depth", "depth")
                        self._ramp = gr.HTML()
                    with gr.Column(min_width=280):
                        self._confidence = _make_picture("Confidence", "confidence")
                        gr.HTML(_format_confidence_legend())
            with gr.Tab("Measure"):
                self._measured = gr.HTML(elem_id="measured")
                self._clickable = _make_picture("Left picture", "clickable")
            with gr.Tab("Point cloud") as self._cloud_tab:
                gr.HTML(js_on_load=_WITHOUT_WEBGL, padding=False)
                self._cloud = gr.Model3D(
                    label="Drag to rotate, scroll to zoom",
                    clear_color=(0.94, 0.95, 0.96, 1.0),
                    height=560,
                )
            with gr.Tab("Files"):
                self._all = gr.DownloadButton("Download all (zip)", variant="primary", elem_id="all")
                self._files = gr.File(label="One at a time", interactive=False, elem_id="files")

    def _connect(self) -> None:
        """Connect events to their handlers."""
        asked = [self._left, self._right, self._model, self._rectify, self._layout, self._calibration]
        asked += [self._focal_px, self._baseline_mm]
        seen = [self._results, self._session, self._view, self._where, self._depth, self._ramp]
        seen += [self._confidence, self._clickable, self._clicks, self._measured]
        seen += [self._tabs, self._cloud]
        taken = [self._status, self._files, self._all]
        sampled = self._sample.click(self._fill_in_sample, None, asked, api_visibility="private")
        for begin in (self._find.click, sampled.then):
            found = begin(
                self._find_depth,
                {*asked, self._position, self._session},
                [*taken, *seen],
                show_progress_on=self._status,
                concurrency_id="matching",
                api_visibility="private",
            )
            found.then(
                self._write_files,
                self._session,
                taken,
                show_progress_on=self._status,
                concurrency_id="matching",
                api_visibility="private",
            )
        self._position.input(
            self._render_view,
            [self._session, self._position],
            [self._view, self._where],
            show_progress="hidden",
            trigger_mode="always_last",
            concurrency_limit=None,
            api_visibility="private",
        )
        # The point cloud is loaded when its tab is opened, under a new name each time. Gradio's viewer stays
        # empty if its value arrives before the viewer is visible, or if the same value arrives twice.
        self._cloud_tab.select(
            self._make_cloud, self._session, self._cloud, concurrency_id="matching", api_visibility="private"
        )
        self._clickable.select(
            self._measure_click,
            [self._session, self._clicks],
            [self._clickable, self._measured, self._clicks],
            show_progress="hidden",
            trigger_mode="multiple",
            concurrency_limit=None,
            api_visibility="private",
        )

    def _fill_in_sample(self) -> dict[Any, Any]:
        """Fill the form with the package's sample pair."""
        folder = sample_folder()
        return {
            self._left: str(folder / "left.jpg"),
            self._right: str(folder / "right.jpg"),
            self._calibration: str(folder / "calib.txt"),
            self._model: "small",
            self._rectify: False,
            self._layout: _DETECTED,
            self._focal_px: 0,
            self._baseline_mm: 0,
        }

    def _find_depth(self, given: dict[Any, Any], progress: Any = gr.Progress()) -> dict[Any, Any]:  # noqa: B008
        """Match the given pictures, and return the page's new content: the result or an error."""
        _remove_files(given[self._session])
        try:
            uploads, folder = self._make_uploads(given), Path(tempfile.mkdtemp(dir=self._folder))
            session = match_uploads(uploads, folder, partial(_report_progress, progress))
            return self._show_result(session, given[self._position])
        except (StereoweaveError, OSError) as error:
            return {
                self._status: self._format_error(error),
                self._results: gr.update(visible=False),
                self._session: None,
            }

    def _format_line(self, line: str) -> str:
        """Format a message as one line, without the paths of temporary folders."""
        return re.sub(rf"{re.escape(str(self._folder))}/\w+/", "", " ".join(line.splitlines()))

    def _format_error(self, error: Exception) -> str:
        return _format_notice([self._format_line(format_error(error, label_of))], problem=True)

    def _write_files(self, session: Session | None, progress: Any = gr.Progress()) -> dict[Any, Any]:  # noqa: B008
        """Write the result's files. This takes as long as all previous steps together."""
        if session is None:
            return {self._files: None}
        _report_progress(progress, 0.8, "writing the files")
        try:
            files, notes = write_all(session)
            packed = zip_files(session.folder / "stereoweave.zip", files)
        except (StereoweaveError, OSError) as error:
            return {self._status: self._format_error(error)}
        return {
            self._status: self._format_summary(session, notes),
            self._files: [str(file) for file in files],
            self._all: gr.update(value=packed and str(packed), visible=packed is not None),
        }

    def _format_summary(self, session: Session, notes: Sequence[Note] = ()) -> str:
        lines = [self._format_line(note.format(label_of)) for note in (*session.result.notes, *notes)]
        return _format_notice([format_summary(session.result.summary), *lines])

    def _make_uploads(self, given: dict[Any, Any]) -> Uploads:
        layout, calibration = given[self._layout], given[self._calibration]
        focal_px, baseline_mm = given[self._focal_px] or None, given[self._baseline_mm] or None
        request = Request(
            format=None if layout == _DETECTED else layout,
            calibration=Path(calibration) if calibration else None,
            focal_px=focal_px,
            baseline_m=baseline_mm and baseline_mm / 1000,
            rectify=given[self._rectify],
        )
        pictures = tuple(Path(file) for file in (given[self._left], given[self._right]) if file)
        backend = Backend(model=given[self._model], provider=self._provider)
        return Uploads(pictures=pictures, request=request, backend=backend)

    def _show_result(self, session: Session, position: float) -> dict[Any, Any]:
        pair, estimate = session.renderer.pair, session.renderer.estimate
        view, where = self._render_view(session, position)
        return {
            self._status: self._format_summary(session),
            self._results: gr.update(visible=True),
            self._session: session,
            self._view: view,
            self._where: where,
            self._depth: colour_depth(session),
            self._ramp: _format_depth_legend(session),
            self._confidence: colour_confidence(estimate.confidence, estimate.occluded),
            self._clickable: pair.left,
            self._clicks: [],
            self._tabs: gr.update(selected="first"),
            self._measured: _format_paragraphs([_TO_MEASURE]),
            self._cloud: None,
            self._files: None,
            self._all: gr.update(value=None, visible=False),
        }

    def _render_view(self, session: Session | None, position: float) -> tuple[Any, str]:
        """Render the view from a position, and return the image and a one-line description."""
        if session is None:
            return gr.skip(), _GONE
        view = session.renderer.view(position)
        unseen = f"{100 * (~view.drawn).mean():.1f} % of it seen by neither camera"
        return view.image, f"{position:g}, {_describe_position(position)}; {unseen}"

    def _make_cloud(self, session: Session | None) -> str | None:
        """Write the point cloud, and return the path of its file; None if there is no point cloud."""
        cloud = session and write_cloud(session.folder / f"{uuid4().hex}.glb", session.result)
        return str(cloud) if cloud else None

    def _measure_click(
        self, session: Session | None, clicks: list[tuple[int, int]], event: gr.SelectData
    ) -> tuple[Any, str, list[tuple[int, int]]]:
        """Mark up to two clicked points in the left image, and describe their depths and their distance."""
        if session is None:
            return gr.skip(), _format_paragraphs([_GONE]), []
        column, row = event.index
        clicks = [*(clicks if len(clicks) < 2 else []), (int(column), int(row))]
        return (
            mark_clicks(session.renderer.pair.left, clicks),
            _format_paragraphs(measure_clicks(session, clicks)),
            clicks,
        )


def _remove_files(session: Session | None) -> None:
    """Remove the files of a result that is no longer shown."""
    if session:
        shutil.rmtree(session.folder, ignore_errors=True)


def _report_progress(progress: Any, share: float, what: str) -> None:
    progress(share, desc=what)


def _make_optional_number(label: str, name: str) -> gr.Number:
    return gr.Number(0, label=label, info="0: unknown", min_width=120, elem_id=name)


def _make_picture(label: str, name: str) -> gr.Image:
    return gr.Image(
        label=label, format="jpeg", interactive=False, buttons=["fullscreen"], elem_id=name, alt_text=label
    )


def _format_notice(lines: Sequence[str], *, problem: bool = False) -> str:
    """Format lines as HTML paragraphs. A problem is highlighted, and announced at once by screen readers."""
    look, role = ("notice problem", "alert") if problem else ("notice", "status")
    return f'<div class="{look}" role="{role}">{_format_paragraphs(lines)}</div>'


def _format_paragraphs(lines: Sequence[str]) -> str:
    return "".join(f"<p>{html.escape(line)}</p>" for line in lines)


def _format_depth_legend(session: Session) -> str:
    far, near = format_colour_range(session.result)
    return _format_legend(
        f"linear-gradient(90deg,{','.join(legend_colours(24))})", f"far: {far}", f"near: {near}"
    )


def _format_confidence_legend() -> str:
    key = f'<i class="key" style="background:{css_colour(OCCLUDED_RGB)}"></i>occluded in the right view'
    return _format_legend("linear-gradient(90deg,#000,#fff)", "low", key, "high")


def _format_legend(colours: str, *labels: str) -> str:
    spans = "".join(f"<span>{label}</span>" for label in labels)
    return f'<div class="ramp" style="background:{colours}"></div><div class="ends">{spans}</div>'


def _describe_position(position: float) -> str:
    """Describe the position of a view in words."""
    if position in (0, 1):
        return "the right picture itself" if position else "the left picture itself"
    if position < 0:
        return "left of the left camera"
    return "right of the right camera" if position > 1 else "between the cameras"
