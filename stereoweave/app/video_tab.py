"""The page's part for videos: a stereo video becomes depth, a view or a layout, after a short preview."""

import shutil
import tempfile
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import aclosing
from functools import partial
from pathlib import Path
from typing import Any

import gradio as gr

from stereoweave.app.events import (
    AT_ONCE,
    LIFETIME_S,
    STILLS,
    VIDEOS,
    CancelButton,
    Cancelled,
    Host,
    scroll_to,
)
from stereoweave.app.frame_panel import FramePanel
from stereoweave.app.newest_frame import NewestFrame
from stereoweave.app.notices import (
    Wording,
    format_notice,
    format_progress,
    format_warnings,
    name_setting,
)
from stereoweave.app.pair_form import MODELS, make_layout_choice, read_layout
from stereoweave.app.still_frame import convert_still
from stereoweave.app.video_outputs import OUTPUTS
from stereoweave.app.video_upload import PREVIEW_S, ConvertedVideo, VideoUpload, convert_upload, keep_uploads
from stereoweave.errors import StereoweaveError
from stereoweave.matching.backend import Backend
from stereoweave.video.packings import FRAME_PACKINGS

_EMPTY = f"""<div class="empty"><ol>
<li>Drop a stereo video: one file that holds both views, or a left and a right file.</li>
<li>Choose what to make, and press <b>Show one frame</b> or <b>Preview {PREVIEW_S} seconds</b> to see
whether you like it.</li>
<li>Press <b>Convert the whole video</b>, and watch its newest frame. It takes many times its own length; keep
this page open.</li>
</ol></div>"""
_ABOUT_FRAME = (
    "One frame, converted as the video would be. Move the slider below it, or choose something else to make."
)
_LABELS = {
    "format": "Layout of a single video",
    "model": "Quality",
    "start_s": "Begin the preview at second",
}
# A partial, because it is sent to the process that does the work.
label_of = partial(name_setting, _LABELS)


class VideoTab:
    """Components and event handlers for a video; the result is kept for an hour.

    Attributes:
        cancel: The form's button that cancels work.
    """

    def __init__(self, host: Host) -> None:
        self._host, self._wording = host, Wording(host.folder, label_of)
        # By visitor, where the video that is being converted shows its newest frame.
        self._newest: dict[str, NewestFrame] = {}
        self._made = gr.State(None, time_to_live=LIFETIME_S, delete_callback=_remove_video)
        with gr.Row():
            with gr.Column(scale=1, min_width=280):
                self._build_form()
            with gr.Column(scale=3, min_width=280):
                self._status = gr.HTML(_EMPTY, elem_id="video-status", padding=False)
                self._panel = FramePanel()
                self._shown = gr.Video(
                    label="Result", visible=False, interactive=False, autoplay=True, elem_id="video"
                )
                self._file = gr.DownloadButton(
                    "Download", variant="primary", visible=False, elem_id="video-file"
                )
        self._connect()

    def _build_form(self) -> None:
        """Build the form for the video and its settings."""
        self._left = gr.File(label="Video with both views, or the left one", height=160, elem_id="video-left")
        self._right = gr.File(label="Right video, if there are two", height=160, elem_id="video-right")
        self._output = gr.Dropdown(
            [(output.label, name) for name, output in OUTPUTS.items()],
            value="depth",
            label="What to make",
            elem_id="video-output",
        )
        self._start_s = gr.Number(
            0,
            label=_LABELS["start_s"],
            info="0: the start",
            elem_id="video-start",
        )
        with gr.Accordion("Layout and quality", open=False):
            self._layout = make_layout_choice(_LABELS["format"], FRAME_PACKINGS, "video-layout")
            self._model = gr.Radio(MODELS[:2], value="small", label=_LABELS["model"], elem_id="video-model")
        self._look = gr.Button("Show one frame", elem_id="video-look")
        self._preview = gr.Button(f"Preview {PREVIEW_S} seconds", variant="primary", elem_id="video-preview")
        self._whole = gr.Button("Convert the whole video", elem_id="video-whole")
        self.cancel = CancelButton("video-cancel")

    def _connect(self) -> None:
        """Connect events to their handlers."""
        form: set[Any] = {
            self._left,
            self._right,
            self._output,
            self._start_s,
            self._layout,
            self._model,
        }
        shown = [self._status, self._shown, self._file, self._made, *self._panel.parts]
        begins = [self._preview.click, self._whole.click]
        scroll_to(self._status, [*begins, self._look.click])
        self.cancel.switch_on([*begins, self._look.click])
        events = [
            begin(handler, {*form, self._made}, shown, show_progress_on=self._status, **VIDEOS)
            for begin, handler in zip(begins, (self._preview_video, self._convert_whole), strict=True)
        ]
        events += self._connect_stills(form)
        self.cancel.connect(self._status, events, [event.then for event in events], self._panel.hide())
        self._panel.output.input(self._show_as, self._panel.output, **AT_ONCE)

    def _connect_stills(self, form: set[Any]) -> list[Any]:
        """Show one frame when its button is pressed, and again after a change of its time or the output.

        Returns:
            The events that show it.
        """
        panel = self._panel
        shown = [self._status, self._start_s, *panel.parts]
        return [
            begin(
                handler,
                {*form, panel.time_s, panel.is_still},
                shown,
                show_progress_on=place,
                trigger_mode="always_last",
                **STILLS,
            )
            for begin, handler, place in (
                (self._look.click, self._show_frame, self._status),
                (panel.time_s.release, self._show_other_frame, panel.pictures),
                (self._output.input, self._show_frame_again, panel.pictures),
            )
        ]

    async def _preview_video(
        self, given: dict[Any, Any], request: gr.Request
    ) -> AsyncIterator[dict[Any, Any]]:
        """Convert some seconds of the video; yield the page's new content."""
        async with aclosing(self._convert(given, given[self._start_s] or 0, request)) as contents:
            async for content in contents:
                yield content

    async def _convert_whole(
        self, given: dict[Any, Any], request: gr.Request
    ) -> AsyncIterator[dict[Any, Any]]:
        """Convert the whole video; yield the page's new content."""
        async with aclosing(self._convert(given, None, request)) as contents:
            async for content in contents:
                yield content

    async def _convert(
        self, given: dict[Any, Any], start_s: float | None, request: gr.Request
    ) -> AsyncGenerator[dict[Any, Any]]:
        folder = Path(tempfile.mkdtemp(dir=self._host.folder))
        newest, visitor = NewestFrame(folder), str(request.session_hash)
        upload = self._read(given, start_s)
        work = partial(convert_upload, upload, folder)
        made: ConvertedVideo | None = None
        self._newest[visitor] = newest
        try:
            yield (shown := self._panel.begin(given[self._output]))
            async with self._host.start(request, work, self.cancel) as job:
                while not await job.is_done():
                    keep_uploads(upload.files)
                    said = {self._status: format_progress(job.share, job.what)}
                    before, shown = shown, said | self._show_newest(newest)
                    if shown != before:
                        yield shown
                made = job.task.result()
        except Cancelled:
            return
        except (StereoweaveError, OSError) as error:
            yield {self._status: self._wording.format_error(error), **self._panel.hide()}
            return
        finally:
            self._newest.pop(visitor, None)
            if made is None:
                shutil.rmtree(folder, ignore_errors=True)
        _remove_video(given[self._made])
        yield {**self._show_result(made), **self._panel.hide()}

    def _show_newest(self, newest: NewestFrame) -> dict[Any, Any]:
        """Return the panel's content for the newest frame, if there is one that it does not show yet."""
        pictures = newest.read()
        return self._panel.show_newest(pictures) if pictures else {}

    def _show_result(self, made: ConvertedVideo) -> dict[Any, Any]:
        size_mb = made.file.stat().st_size / 1e6
        return {
            self._status: format_warnings(made.warnings) + format_notice([made.summary, *made.facts]),
            self._shown: gr.update(value=str(made.file), visible=True),
            self._file: gr.update(
                value=str(made.file), label=f"Download {made.file.name} ({size_mb:.1f} MB)", visible=True
            ),
            self._made: made,
        }

    def _show_as(self, output: str, request: gr.Request) -> None:
        """Show the newest frames of the visitor's conversion as another output."""
        if newest := self._newest.get(str(request.session_hash)):
            newest.ask(output)

    async def _show_frame(
        self,
        given: dict[Any, Any],
        request: gr.Request,
        progress: Any = gr.Progress(),  # noqa: B008
    ) -> dict[Any, Any]:
        """Convert one frame of the video, and return the page's new content."""
        return await self._convert_frame(given, given[self._start_s] or 0, request, progress)

    async def _show_other_frame(
        self,
        given: dict[Any, Any],
        request: gr.Request,
        progress: Any = gr.Progress(),  # noqa: B008
    ) -> dict[Any, Any]:
        """Convert the frame at the slider's time, where previews then begin."""
        time_s = given[self._panel.time_s]
        return {self._start_s: time_s} | await self._convert_frame(given, time_s, request, progress)

    async def _show_frame_again(
        self,
        given: dict[Any, Any],
        request: gr.Request,
        progress: Any = gr.Progress(),  # noqa: B008
    ) -> dict[Any, Any]:
        """Convert the frame that is shown, if one is, to another output."""
        if not given[self._panel.is_still]:
            return {self._status: gr.skip()}
        return await self._convert_frame(given, given[self._panel.time_s], request, progress)

    async def _convert_frame(
        self, given: dict[Any, Any], time_s: float, request: gr.Request, progress: Any
    ) -> dict[Any, Any]:
        work = partial(convert_still, self._read(given, time_s))
        try:
            still = await self._host.work(request, work, progress, self.cancel)
        except Cancelled:
            return {self._status: gr.skip()}
        except (StereoweaveError, OSError) as error:
            return {self._status: self._wording.format_error(error), **self._panel.hide()}
        said = format_warnings(still.warnings) + format_notice([_ABOUT_FRAME, *still.facts])
        return {self._status: said, **self._panel.show_still(still)}

    def _read(self, given: dict[Any, Any], start_s: float | None) -> VideoUpload:
        return VideoUpload(
            files=tuple(Path(file) for file in (given[self._left], given[self._right]) if file),
            format=read_layout(given[self._layout]),
            output=given[self._output],
            start_s=start_s,
            backend=Backend(model=given[self._model], provider=self._host.provider),
            name_of=label_of,
        )


def _remove_video(made: ConvertedVideo | None) -> None:
    """Remove a video that is no longer shown."""
    if made:
        shutil.rmtree(made.file.parent, ignore_errors=True)
