"""The page's form for a pair of pictures and its settings."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import gradio as gr

from stereoweave.app.events import CancelButton
from stereoweave.app.notices import name_setting
from stereoweave.app.session import Uploads
from stereoweave.errors import StereoweaveError
from stereoweave.matching.backend import Backend
from stereoweave.pictures.loading import FORMATS
from stereoweave.pictures.prepare import Request
from stereoweave.pictures.sample import sample_folder

_DETECTED = "detected"
# No lens has a focal length of more pixels, and no rig a baseline of more millimetres.
_MOST = 1_000_000
MODELS = [("fast", "small"), ("fine", "base"), ("finest", "best")]

# Labels of the fields for a pair, by setting.
LABELS = {
    "format": "Layout of a single file",
    "baseline_m": "Baseline, mm",
    "calibration": "Calibration file, for metres",
    "focal_px": "Focal length, px",
    "model": "Quality",
    "rectify": "Align the pictures",
    "crop": "Cut off borders",
    "position": "Viewpoint",
    "video": "Video",
}


def label_of(setting: str) -> str | None:
    """Return the form's name for a setting, or what to do with its field; None if it has no field."""
    if setting == "no_rectify":
        return f"untick {label_of('rectify')}"
    return name_setting(LABELS, setting)


class PairForm:
    """The fields for the pictures and settings, and the buttons."""

    def __init__(self) -> None:
        self.left = gr.File(label="Left picture, or one file with both views", height=160, elem_id="left")
        self.right = gr.File(label="Right picture", height=160, elem_id="right")
        self.rectify = gr.Checkbox(
            value=True,
            label=LABELS["rectify"],
            info="Where needed, as when taken by hand. Untick it to keep the pictures as they are.",
            elem_id="rectify",
        )
        self.model = gr.Radio(
            MODELS,
            value="best",
            label=LABELS["model"],
            info="Fine takes 2 times as long as fast, finest 5 times.",
            elem_id="model",
        )
        with gr.Accordion("Layout and calibration", open=False):
            self.layout = make_layout_choice(LABELS["format"], FORMATS, "layout")
            self.calibration = gr.File(label=LABELS["calibration"], height=140, elem_id="calibration")
            with gr.Row():
                self.focal_px = _make_optional_number(LABELS["focal_px"], "focal")
                self.baseline_mm = _make_optional_number(LABELS["baseline_m"], "baseline")
        self.find = gr.Button("Find depth", variant="primary", elem_id="find")
        self.cancel = CancelButton("cancel")
        self.sample = gr.Button("Try the sample", elem_id="sample")

    @property
    def fields(self) -> list[Any]:
        """All fields."""
        pictures = [self.left, self.right, self.model, self.rectify, self.layout, self.calibration]
        return [*pictures, self.focal_px, self.baseline_mm]

    def fill_in_sample(self) -> dict[Any, Any]:
        """Return the fields' values for the package's sample pair."""
        folder = sample_folder()
        return {
            self.left: str(folder / "left.jpg"),
            self.right: str(folder / "right.jpg"),
            self.calibration: str(folder / "calib.txt"),
            self.model: "best",
            self.rectify: True,
            self.layout: _DETECTED,
            self.focal_px: 0,
            self.baseline_mm: 0,
        }

    def read(self, given: dict[Any, Any], provider: str) -> Uploads:
        """Return the uploads and settings that a visitor has given."""
        calibration = given[self.calibration]
        focal_px = _read_positive("focal_px", given[self.focal_px])
        baseline_mm = _read_positive("baseline_m", given[self.baseline_mm])
        where_needed = True if calibration else None
        request = Request(
            format=read_layout(given[self.layout]),
            calibration=Path(calibration) if calibration else None,
            focal_px=focal_px,
            baseline_m=baseline_mm and baseline_mm / 1000,
            rectify=where_needed if given[self.rectify] else False,
        )
        pictures = tuple(Path(file) for file in (given[self.left], given[self.right]) if file)
        backend = Backend(model=given[self.model], provider=provider)
        return Uploads(pictures=pictures, request=request, backend=backend, name_of=label_of)


def make_layout_choice(label: str, names: Iterable[str], elem_id: str) -> gr.Dropdown:
    """Make a field to choose how one file holds both views; the first choice is to detect it."""
    choices: list[Any] = [_DETECTED, *((name.replace("_", " "), name) for name in names)]
    return gr.Dropdown(choices, value=_DETECTED, label=label, elem_id=elem_id)


def read_layout(given: str) -> str | None:
    """Return the layout that a visitor has chosen; None to detect it."""
    return None if given == _DETECTED else given


def _read_positive(setting: str, given: float | None) -> float | None:
    """Return a number that a visitor has typed; None if it is unknown."""
    if not given:
        return None
    if not 0 < given <= _MOST:
        raise StereoweaveError(
            f"expected a number from 0 to {_MOST:,}, where 0 is unknown, found {given:g}", setting=setting
        )
    return given


def _make_optional_number(label: str, name: str) -> gr.Number:
    return gr.Number(0, label=label, info="0: unknown", min_width=120, elem_id=name)
