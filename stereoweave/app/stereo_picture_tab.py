"""The page's tab that offers a result as 3-D pictures, with a preview of each."""

from functools import partial
from pathlib import Path
from typing import Any
from uuid import uuid4

import gradio as gr

from stereoweave.app.events import AT_ONCE, MATCHING, CancelButton, Cancelled, Host
from stereoweave.app.notices import Wording, format_frame, format_paragraphs
from stereoweave.app.pair_form import LABELS, label_of
from stereoweave.app.session_store import GONE, SessionStore
from stereoweave.app.stereo_pictures import AUTOMATIC_PX, FULL_PX, KINDS, Wish, write_stereo_picture
from stereoweave.errors import StereoweaveError

_FIRST = "anaglyph_dubois"
_SIZES = [
    ("automatic", AUTOMATIC_PX),
    ("full", FULL_PX),
    *((f"{side} px", side) for side in (2560, 1600, 1080, 640)),
]
# Gradio opens the list scrolled to its end.
_SHOW_CHOICE = """() => setTimeout(() => {
    const list = document.querySelector("#kind [role=listbox]");
    if (!list) return;
    list.scrollTop = 0;
    list.querySelector("[aria-selected=true]")?.scrollIntoView({ block: "nearest" });
}, 100)"""


class StereoPictureTab:
    """A choice of 3-D pictures, with how to look at each, a preview, and its file.

    Args:
        host: What the page's parts share.
        cancel: The form's button that cancels work.
        sessions: The visitors' results.
        key: The key of the visitor's result.
        position: The viewpoint of the kind that shows one view.
    """

    def __init__(
        self, host: Host, cancel: CancelButton, sessions: SessionStore, key: gr.State, position: gr.Slider
    ) -> None:
        self._host, self._wording, self._cancel = host, Wording(host.folder, label_of), cancel
        self._sessions, self._key, self._position = sessions, key, position
        with gr.Row(equal_height=True):
            self._kind = gr.Dropdown(
                [(kind.label, name) for name, kind in KINDS.items()],
                value=_FIRST,
                label="Kind of 3-D picture",
                elem_id="kind",
                scale=2,
                min_width=240,
            )
            self._size = gr.Dropdown(
                _SIZES, value=AUTOMATIC_PX, label="Longer side", elem_id="size", min_width=140
            )
            self._crops = gr.Checkbox(
                label=LABELS["crop"],
                info="Otherwise, they are filled in.",
                elem_id="crop",
                min_width=180,
            )
        self._viewing = gr.HTML(format_paragraphs([KINDS[_FIRST].viewing]), elem_id="viewing")
        self._preview = gr.Image(
            label="Preview", interactive=False, buttons=["fullscreen"], elem_id="preview", alt_text="Preview"
        )
        self._page = gr.HTML(visible=False, elem_id="photo", padding=False)
        self._file = gr.DownloadButton("Download", variant="primary", visible=False, elem_id="picture")

    @property
    def parts(self) -> list[Any]:
        """The parts that belong to one result."""
        return [self._viewing, self._preview, self._page, self._file]

    def empty(self) -> dict[Any, Any]:
        """Return the parts' values for a new result."""
        return {
            self._preview: gr.update(value=None, visible=True),
            self._page: gr.update(value="", visible=False),
            self._file: gr.update(value=None, visible=False),
        }

    def connect(self, tab: gr.Tab) -> list[Any]:
        """Make the chosen picture of the session when the tab is opened or a choice changes.

        Returns:
            The events that make it.
        """
        begins = [tab.select, self._kind.input, self._size.input, self._crops.input]
        self._cancel.switch_on(begins)
        asked: set[Any] = {self._key, self._kind, self._size, self._crops, self._position}
        self._kind.focus(None, None, None, js=_SHOW_CHOICE, api_visibility="private")
        self._kind.input(
            _describe,
            self._kind,
            [self._viewing, self._crops],
            # By default, a choice made before the answer to the last one has come would be ignored.
            trigger_mode="always_last",
            **AT_ONCE,
        )
        return [
            begin(
                self._make,
                asked,
                self.parts,
                show_progress_on=[self._preview, self._page],
                trigger_mode="always_last",
                **MATCHING,
            )
            for begin in begins
        ]

    async def _make(
        self,
        given: dict[Any, Any],
        request: gr.Request,
        progress: Any = gr.Progress(),  # noqa: B008
    ) -> dict[Any, Any]:
        """Write the picture unless it is there, and return how to look at it, its preview and its file."""
        kind, key = given[self._kind], given[self._key]
        session = self._sessions.find(key)
        viewing = format_paragraphs([KINDS[kind].viewing])
        if session is None:
            # The tab is shown only with a result, so its session has expired; the key expires with it.
            return {self._viewing: format_paragraphs([GONE]), **self.empty()}
        wish = Wish(
            kind=kind,
            longer_side_px=given[self._size],
            crops=given[self._crops],
            position=given[self._position],
        ).plain()
        try:
            async with session.making:
                if wish not in session.stereo_pictures:
                    work = partial(write_stereo_picture, wish, session.result, session.folder / uuid4().hex)
                    made = await self._host.work(request, work, progress, self._cancel)
                    session.stereo_pictures[wish] = made
        except Cancelled:
            return {self._viewing: viewing}
        except (StereoweaveError, OSError) as error:
            if self._sessions.keeps(key, session):
                return {self._viewing: self._wording.format_error(error), **self.empty()}
        if not self._sessions.keeps(key, session):
            return {self._viewing: format_paragraphs([GONE]), **self.empty()}
        made = session.stereo_pictures[wish]
        size_mb = made.file.stat().st_size / 1e6
        label = f"Download {made.file.name} ({size_mb:.1f} MB)"
        return {
            self._viewing: viewing,
            **self._show(made.shown, session.pair.left.shape),
            self._file: gr.update(value=str(made.file), label=label, visible=True),
        }

    def _show(self, shown: Path, shape: tuple[int, ...]) -> dict[Any, Any]:
        """Return the values of the parts that show a picture, or a page in a frame of the picture's shape."""
        is_page = shown.suffix == ".html"
        style = f"aspect-ratio: {shape[1]} / {shape[0]}"
        frame = format_frame(shown.read_text(encoding="utf-8"), "3-D photo", style) if is_page else ""
        return {
            self._preview: gr.update(value=None if is_page else str(shown), visible=not is_page),
            self._page: gr.update(value=frame, visible=is_page),
        }


def _describe(kind: str) -> tuple[str, Any]:
    """Return how to look at a kind, and whether its borders can be cut off."""
    return format_paragraphs([KINDS[kind].viewing]), gr.update(visible=Wish(kind=kind).can_crop)
