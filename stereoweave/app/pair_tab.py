"""The page's part for a pair of pictures: its form, and the tabs that show its depth."""

import asyncio
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gradio as gr

from stereoweave.app.events import LIFETIME_S, MATCHING, Cancelled, Host, scroll_to
from stereoweave.app.notices import (
    Wording,
    format_frame,
    format_legend,
    format_notice,
    format_paragraphs,
    format_warnings,
)
from stereoweave.app.pair_form import LABELS, PairForm, label_of
from stereoweave.app.session import (
    Session,
    colour_depth,
    find_early_warnings,
    format_colour_range,
    format_summary,
    mark_clicks,
    match_uploads,
    measure_clicks,
    open_session,
    write_all,
    write_shown_report,
)
from stereoweave.app.session_store import GONE, SessionStore
from stereoweave.app.stereo_picture_tab import StereoPictureTab
from stereoweave.errors import Note, StereoweaveError
from stereoweave.io.colormap import OCCLUDED_RGB, colour_confidence, css_colour, legend_colours
from stereoweave.outputs.run import Result

_EMPTY = """<div class="empty"><ol>
<li>Drop the left and the right picture, or one file that holds both:
side by side, one above the other, MPO or JPS.</li>
<li>Press <b>Find depth</b>. Pictures taken by hand or by two separate cameras are aligned first.</li>
<li>Move between the cameras, turn the scene in 3-D, measure, and download 3-D pictures and files.</li>
</ol></div>"""
_ABOUT_FILES = """<p><b>report.html</b> shows the result in any browser; <b>preview.png</b> is the depth in
colour. <b>depth</b> is in metres, <b>disparity</b> in pixels; <b>cloud</b> and <b>mesh</b> open in 3-D
programs. PNG files are for image editors; PFM, NPY and TIFF files are for programming. There are metres, and
thus depth, cloud and mesh, only with a calibration, or with focal length and baseline.</p>"""
_ABOUT_NOTES = "What was done with the pictures:"
_ABOUT_REMEDIES = "What was done with the pictures, and in brackets the field that changes it:"
_TO_MEASURE = "Click two points in the left picture to see their depths and the distance between them here."
_TO_COMPARE = (
    "Click two points in the left picture to compare their disparities: what is nearer has a larger one. "
    "Distances in metres need a calibration file, or the focal length and the baseline."
)
# A result takes 60 MB plus 19 bytes per pixel of the left picture in memory (0.5 GB at 24 megapixels), and
# the size of its files on disk (0.9 GB at 24 megapixels).
_MOST_SESSIONS = 4


class PairTab:
    """Components and event handlers for a pair; `SessionStore` keeps the results.

    Attributes:
        cancel: The form's button that cancels work.
    """

    def __init__(self, host: Host) -> None:
        self._host, self._wording = host, Wording(host.folder, label_of)
        self._sessions = SessionStore(_MOST_SESSIONS)
        self._key = gr.State(None, time_to_live=LIFETIME_S, delete_callback=self._sessions.remove)
        self._clicks = gr.State([])
        with gr.Row():
            with gr.Column(scale=1, min_width=280):
                self._form = PairForm()
                self.cancel = self._form.cancel
            with gr.Column(scale=3, min_width=280):
                self._status = gr.HTML(_EMPTY, elem_id="status", padding=False)
                with gr.Column(visible=False) as self._results:
                    self._build_results()
        self._connect()

    def _build_results(self) -> None:
        """Build the part that shows results."""
        with gr.Tabs() as self._tabs:
            with gr.Tab("View", id="first"):
                self._build_views()
            with gr.Tab("3-D picture") as self._picture_tab:
                self._stereo = StereoPictureTab(
                    self._host, self.cancel, self._sessions, self._key, self._position
                )
            with gr.Tab("Explore") as self._report_tab:
                self._report = gr.HTML(elem_id="report", padding=False, min_height=200)
            with gr.Tab("Measure"):
                self._measured = gr.HTML(elem_id="measured")
                self._clickable = _make_picture("Left picture", "clickable")
            with gr.Tab("Files"):
                gr.HTML(_ABOUT_FILES, elem_id="about-files")
                self._all = gr.DownloadButton("Download all (zip)", variant="primary", elem_id="all")
                self._files = gr.File(label="One at a time", interactive=False, elem_id="files")

    def _build_views(self) -> None:
        """Build the tab with the view, its slider, the depth and the confidence."""
        self._view = _make_picture("New view", "view")
        self._position = gr.Slider(
            -0.5,
            1.5,
            value=0.5,
            step=0.05,
            label=LABELS["position"],
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

    def _connect(self) -> None:
        """Connect events to their handlers."""
        form, taken = self._form, [self._status, *self._file_parts]
        scroll_to(self._status, [form.find.click, form.sample.click])
        self.cancel.switch_on([form.find.click, form.sample.click])
        sampled = form.sample.click(form.fill_in_sample, None, form.fields, api_visibility="private")
        long, ends = [], []
        for begin in (form.find.click, sampled.then):
            found = begin(
                self._find_depth,
                {*form.fields, self._position, self._key},
                [*taken, *self._shown_parts],
                show_progress_on=self._status,
                **MATCHING,
            )
            written = found.then(
                self._write_files, self._key, taken, show_progress_on=self._files, **MATCHING
            )
            scroll_to(self._status, [found.then])
            long += [found, written]
            ends.append(written.then)
        made = [self._connect_report(), *self._stereo.connect(self._picture_tab)]
        self.cancel.connect(self._status, [*long, *made], [*ends, *(event.then for event in made)])
        self._connect_views()

    def _connect_report(self) -> Any:
        """Show the report when its tab is opened, because it cannot measure itself while hidden.

        Returns:
            The event that shows it.
        """
        self.cancel.switch_on([self._report_tab.select])
        return self._report_tab.select(
            self._show_report, self._key, self._report, show_progress_on=self._report, **MATCHING
        )

    def _connect_views(self) -> None:
        """Connect the events of the results that are drawn at once."""
        self._position.input(
            self._move_view,
            [self._key, self._position],
            [self._view, self._where],
            show_progress="hidden",
            trigger_mode="always_last",
            concurrency_limit=None,
            api_visibility="private",
        )
        self._clickable.select(
            self._measure_click,
            [self._key, self._clicks],
            [self._clickable, self._measured, self._clicks],
            show_progress="hidden",
            trigger_mode="multiple",
            concurrency_limit=None,
            api_visibility="private",
        )

    @property
    def _file_parts(self) -> list[Any]:
        return [self._files, self._all]

    @property
    def _shown_parts(self) -> list[Any]:
        pictures = [self._view, self._where, self._depth, self._ramp, self._confidence, self._clickable]
        parts = [self._results, self._key, self._clicks, self._measured, self._tabs, self._report]
        return [*pictures, *parts, *self._stereo.parts]

    async def _find_depth(
        self,
        given: dict[Any, Any],
        request: gr.Request,
        progress: Any = gr.Progress(),  # noqa: B008
    ) -> dict[Any, Any]:
        """Match the given pictures, and return the page's new content: the result or an error."""
        try:
            uploads = self._form.read(given, self._host.provider)
            result = await self._host.work(request, partial(match_uploads, uploads), progress, self.cancel)
            progress(0.6, desc="showing")
            # Otherwise, all other visitors would wait.
            session, shown = await asyncio.to_thread(self._open_result, result, given[self._position])
        except Cancelled:
            return {self._status: gr.skip()}
        except (StereoweaveError, OSError) as error:
            self._sessions.remove(given[self._key])
            return {
                self._status: self._wording.format_error(error),
                self._results: gr.update(visible=False),
                self._key: None,
            }
        # Not in the thread, which goes on if the visitor cancels meanwhile.
        return {**shown, self._key: self._sessions.keep(session, given[self._key])}

    async def _write_files(
        self,
        key: str | None,
        request: gr.Request,
        progress: Any = gr.Progress(),  # noqa: B008
    ) -> dict[Any, Any]:
        """Write the result's files. This takes as long as all previous steps together."""
        session = self._sessions.find(key)
        if session is None:
            return {self._files: None}
        if session.is_written:  # a cancelled job is followed by this step, too
            return {self._files: gr.skip()}
        work = partial(write_all, session.result, session.folder)
        try:
            written = await self._host.work(request, work, progress, self.cancel)
        except Cancelled:
            return {self._status: gr.skip()}
        except (StereoweaveError, OSError) as error:
            shown: dict[Any, Any] = {self._status: self._wording.format_error(error)}
        else:
            archive = written.archive
            shown = {
                self._status: self._format_summary(session, written.warnings, written.notes),
                self._files: [str(file) for file in written.files],
                self._all: gr.update(value=archive and str(archive), visible=archive is not None),
            }
        # Otherwise, the visitor has found another depth meanwhile.
        return shown if self._sessions.keeps(key, session) else {self._status: gr.skip()}

    def _format_summary(self, session: Session, warnings: Sequence[Note], notes: Sequence[Note] = ()) -> str:
        banner = format_warnings(self._wording.format_notes(warnings))
        lines = self._wording.format_notes([*session.result.notes, *notes])
        if lines:
            lines.insert(0, _ABOUT_REMEDIES if any("(“" in line for line in lines) else _ABOUT_NOTES)
        return banner + format_notice([*format_summary(session.result.summary), *lines])

    def _open_result(self, result: Result, position: float) -> tuple[Session, dict[Any, Any]]:
        """Return the session of a result, and the page's new content but for the session's key."""
        session = open_session(result, Path(tempfile.mkdtemp(dir=self._host.folder)))
        pair, estimate = session.pair, session.estimate
        view, where = _render_view(session, position)
        return session, {
            self._status: self._format_summary(session, find_early_warnings(session.result)),
            self._results: gr.update(visible=True),
            self._view: view,
            self._where: where,
            self._depth: colour_depth(session),
            self._ramp: _format_depth_legend(session),
            self._confidence: colour_confidence(estimate.confidence, estimate.occluded),
            self._clickable: pair.left,
            self._clicks: [],
            self._tabs: gr.update(selected="first"),
            self._measured: format_paragraphs([_TO_MEASURE if pair.camera else _TO_COMPARE]),
            self._report: "",
            self._files: None,
            self._all: gr.update(value=None, visible=False),
            **self._stereo.empty(),
        }

    def _move_view(self, key: str | None, position: float) -> tuple[Any, str]:
        """Render the view from another position, and return the image and a one-line description."""
        session = self._sessions.find(key)
        return (gr.skip(), GONE) if session is None else _render_view(session, position)

    async def _show_report(
        self,
        key: str | None,
        request: gr.Request,
        progress: Any = gr.Progress(),  # noqa: B008
    ) -> str:
        """Write the report unless it is there, and return a frame that shows it, or an error."""
        session = self._sessions.find(key)
        if session is None:
            return format_paragraphs([GONE])
        file = session.shown_report
        if not file.exists():
            work = partial(write_shown_report, session.result, file)
            try:
                await self._host.work(request, work, progress, self.cancel)
            except Cancelled:
                return ""
            except (StereoweaveError, OSError) as error:
                if self._sessions.keeps(key, session):
                    return self._wording.format_error(error)
        if not self._sessions.keeps(key, session):
            return format_paragraphs([GONE])
        try:
            return format_frame(file.read_text(encoding="utf-8"), title="Report")
        except OSError:  # it has expired meanwhile
            return format_paragraphs([GONE])

    def _measure_click(
        self, key: str | None, clicks: list[tuple[int, int]], event: gr.SelectData
    ) -> tuple[Any, str, list[tuple[int, int]]]:
        """Mark up to two clicked points in the left image, and describe their depths and their distance."""
        session = self._sessions.find(key)
        if session is None:
            return gr.skip(), format_paragraphs([GONE]), []
        column, row = event.index
        clicks = [*(clicks if len(clicks) < 2 else []), (int(column), int(row))]
        return (
            mark_clicks(session.pair.left, clicks),
            format_paragraphs(measure_clicks(session, clicks)),
            clicks,
        )


def _render_view(session: Session, position: float) -> tuple[Any, str]:
    """Render the view from a position, and return the image and a one-line description."""
    view = session.renderer.view(position)
    unseen = f"{100 * (~view.drawn).mean():.1f} % of it filled in, as neither camera saw it"
    return view.image, f"{position:g}, {_describe_position(position)}; {unseen}"


def _make_picture(label: str, name: str) -> gr.Image:
    return gr.Image(
        label=label, format="jpeg", interactive=False, buttons=["fullscreen"], elem_id=name, alt_text=label
    )


def _format_depth_legend(session: Session) -> str:
    far, near = format_colour_range(session)
    return format_legend(
        f"linear-gradient(90deg,{','.join(legend_colours(24))})", f"far: {far}", f"near: {near}"
    )


def _format_confidence_legend() -> str:
    key = f'<i class="key" style="background:{css_colour(OCCLUDED_RGB)}"></i>seen by the left camera only'
    return format_legend("linear-gradient(90deg,#000,#fff)", "unsure", key, "sure")


def _describe_position(position: float) -> str:
    """Describe the position of a view in words."""
    if position in (0, 1):
        return "the right picture itself" if position else "the left picture itself"
    if position < 0:
        return "left of the left camera"
    return "right of the right camera" if position > 1 else "between the cameras"
