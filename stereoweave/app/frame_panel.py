"""The part of the page that shows one frame of a video: the left view beside what it becomes."""

import base64
from typing import Any

import gradio as gr

from stereoweave.app.newest_frame import FramePictures
from stereoweave.app.still_frame import StillFrame
from stereoweave.app.video_outputs import OUTPUTS

_CHOICES = [(output.label, name) for name, output in OUTPUTS.items()]


class FramePanel:
    """Two pictures of a frame; above them, while a video is converted, the choice of the second one.

    Attributes:
        output: Choice of what the newest frame of a conversion is shown as.
        time_s: Slider to the time of a frame that was chosen by it; not shown while a video is converted.
        pictures: The pictures, each with a line below it.
        is_still: Whether the frame was chosen by its time.
        parts: All components.
    """

    def __init__(self) -> None:
        self.is_still = gr.State(False)
        with gr.Column(visible=False, elem_id="video-panel") as self._column:
            self.output = gr.Dropdown(_CHOICES, label="Show the newest frame as", elem_id="video-shown-as")
            self.pictures = gr.HTML(elem_id="video-frame", padding=False)
            self.time_s = gr.Slider(
                0, 1, step=0.1, label="Frame at second", buttons=[], visible=False, elem_id="video-time"
            )
        self.parts = [self.is_still, self._column, self.output, self.pictures, self.time_s]

    def begin(self, output: str) -> dict[Any, Any]:
        """Return the content before the first frame of a conversion to an output."""
        return {**self.hide(), self.output: output}

    def show_newest(self, pictures: FramePictures) -> dict[Any, Any]:
        """Return the content for the newest frame of a conversion."""
        return {
            self.is_still: False,
            self._column: gr.update(visible=True),
            self.output: gr.update(visible=True),  # a frame that was chosen before may come meanwhile
            self.pictures: _format_pictures(pictures),
            self.time_s: gr.update(visible=False),
        }

    def show_still(self, still: StillFrame) -> dict[Any, Any]:
        """Return the content for a frame that was chosen by its time."""
        return {
            self.is_still: True,
            self._column: gr.update(visible=True),
            self.output: gr.update(visible=False),
            self.pictures: _format_pictures(still.pictures),
            self.time_s: gr.update(value=still.pictures.time_s, maximum=max(still.last_s, 0.1), visible=True),
        }

    def hide(self) -> dict[Any, Any]:
        """Return the content that shows no frame."""
        return {self.is_still: False, self._column: gr.update(visible=False), self.pictures: ""}


def _format_pictures(pictures: FramePictures) -> str:
    """Format the pictures as HTML, with the time of the frame and how to look at the second one."""
    output = OUTPUTS[pictures.output]
    figures = (
        _format_figure(pictures.left, f"Left view at {pictures.shown_time}"),
        _format_figure(pictures.made, f"{output.label}. {output.viewing}"),
    )
    return f'<div class="frames">{"".join(figures)}</div>'


def _format_figure(jpeg: bytes, caption: str) -> str:
    address = f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}"
    return f'<figure><img src="{address}" alt="{caption}"><figcaption>{caption}</figcaption></figure>'
