"""The page's part for videos: a stereo video becomes depth, a view or a layout, after a short preview."""

import shutil
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import gradio as gr

from stereoweave.app.events import LIFETIME_S, VIDEOS, Host, connect_cancel, scroll_to, switch
from stereoweave.app.notices import Wording, format_notice, format_warnings, name_setting
from stereoweave.app.pair_form import MODELS, make_layout_choice, read_layout
from stereoweave.app.video_upload import OUTPUTS, PREVIEW_S, ConvertedVideo, VideoUpload, convert_upload
from stereoweave.errors import StereoweaveError
from stereoweave.matching.backend import Backend
from stereoweave.video.packings import FRAME_PACKINGS

_EMPTY = f"""<div class="empty"><ol>
<li>Drop a stereo video: one file that holds both views, or a left and a right file.</li>
<li>Choose what to make, and press <b>Preview {PREVIEW_S} seconds</b> to see whether you like it.</li>
<li>Press <b>Convert the whole video</b>. It takes many times its own length; keep this page open.</li>
</ol></div>"""
_LABELS = {
    "format": "Layout of a single video",
    "model": "Quality",
    "start_s": "Begin the preview at second",
}
# A partial, because it is sent to the process that does the work.
label_of = partial(name_setting, _LABELS)


class VideoTab:
    """Components and event handlers for a video; the result is kept for an hour."""

    def __init__(self, host: Host) -> None:
        self._host, self._wording = host, Wording(host.folder, label_of)
        self._made = gr.State(None, time_to_live=LIFETIME_S, delete_callback=_remove_video)
        with gr.Row():
            with gr.Column(scale=1, min_width=280):
                self._build_form()
            with gr.Column(scale=3, min_width=280):
                self._status = gr.HTML(_EMPTY, elem_id="video-status", padding=False)
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
        self._preview = gr.Button(f"Preview {PREVIEW_S} seconds", variant="primary", elem_id="video-preview")
        self._whole = gr.Button("Convert the whole video", elem_id="video-whole")
        self._cancel = gr.Button("Cancel", variant="stop", interactive=False, elem_id="video-cancel")

    def _connect(self) -> None:
        """Connect events to their handlers."""
        asked: set[Any] = {
            self._left,
            self._right,
            self._output,
            self._start_s,
            self._layout,
            self._model,
            self._made,
        }
        shown = [self._status, self._shown, self._file, self._made]
        begins = [self._preview.click, self._whole.click]
        scroll_to(self._status, begins)
        switch(self._cancel, begins, on=True)
        events = [
            begin(handler, asked, shown, show_progress_on=self._status, **VIDEOS)
            for begin, handler in zip(begins, (self._preview_video, self._convert_whole), strict=True)
        ]
        connect_cancel(self._cancel, self._status, events)
        switch(self._cancel, [event.then for event in events], on=False)

    async def _preview_video(
        self,
        given: dict[Any, Any],
        request: gr.Request,
        progress: Any = gr.Progress(),  # noqa: B008
    ) -> dict[Any, Any]:
        """Convert some seconds of the video, and return the page's new content."""
        return await self._convert(given, given[self._start_s] or 0, request, progress)

    async def _convert_whole(
        self,
        given: dict[Any, Any],
        request: gr.Request,
        progress: Any = gr.Progress(),  # noqa: B008
    ) -> dict[Any, Any]:
        """Convert the whole video, and return the page's new content."""
        return await self._convert(given, None, request, progress)

    async def _convert(
        self, given: dict[Any, Any], start_s: float | None, request: gr.Request, progress: Any
    ) -> dict[Any, Any]:
        folder = Path(tempfile.mkdtemp(dir=self._host.folder))
        work = partial(convert_upload, self._read(given, start_s), folder)
        made: ConvertedVideo | None = None
        try:
            made = await self._host.work(request, work, progress)
        except (StereoweaveError, OSError) as error:
            return {self._status: self._wording.format_error(error)}
        finally:
            if made is None:
                shutil.rmtree(folder, ignore_errors=True)
        _remove_video(given[self._made])
        size_mb = made.file.stat().st_size / 1e6
        return {
            self._status: format_warnings(made.warnings) + format_notice([made.summary]),
            self._shown: gr.update(value=str(made.file), visible=True),
            self._file: gr.update(
                value=str(made.file), label=f"Download {made.file.name} ({size_mb:.1f} MB)", visible=True
            ),
            self._made: made,
        }

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
