"""The page's tab that offers a result as 3-D pictures: layouts, animations and the depth map."""

from functools import partial
from typing import Any

import gradio as gr

from stereoweave.app.events import MATCHING, Host, switch
from stereoweave.app.notices import Wording, format_paragraphs
from stereoweave.app.session import Session
from stereoweave.app.stereo_pictures import KINDS, write_stereo_picture
from stereoweave.errors import StereoweaveError

_FIRST = "anaglyph_dubois"


class StereoPictureTab:
    """A choice of 3-D pictures, with how to look at each, a preview, and its file."""

    def __init__(self, host: Host, wording: Wording) -> None:
        self._host, self._wording = host, wording
        self._kind = gr.Dropdown(
            [(kind.label, name) for name, kind in KINDS.items()],
            value=_FIRST,
            label="Kind of 3-D picture",
            elem_id="kind",
        )
        self._viewing = gr.HTML(format_paragraphs([KINDS[_FIRST].viewing]), elem_id="viewing")
        self._preview = gr.Image(
            label="Preview", interactive=False, buttons=["fullscreen"], elem_id="preview", alt_text="Preview"
        )
        self._file = gr.DownloadButton("Download", variant="primary", visible=False, elem_id="picture")

    @property
    def parts(self) -> list[Any]:
        """The parts that belong to one result."""
        return [self._viewing, self._preview, self._file]

    def empty(self) -> dict[Any, Any]:
        """Return the parts' values for a new result."""
        return {self._preview: None, self._file: gr.update(value=None, visible=False)}

    def connect(self, tab: gr.Tab, session: gr.State, cancel: gr.Button) -> list[Any]:
        """Make the chosen picture of a session when the tab is opened or the choice changes.

        Returns:
            The events that make it.
        """
        begins = [tab.select, self._kind.input]
        switch(cancel, begins, on=True)
        return [
            begin(
                self._make,
                [session, self._kind],
                self.parts,
                show_progress_on=self._preview,
                trigger_mode="always_last",
                **MATCHING,
            )
            for begin in begins
        ]

    async def _make(
        self,
        session: Session | None,
        kind: str,
        request: gr.Request,
        progress: Any = gr.Progress(),  # noqa: B008
    ) -> dict[Any, Any]:
        """Write the picture unless it is there, and return how to look at it, its preview and its file."""
        viewing = format_paragraphs([KINDS[kind].viewing])
        if session is None:
            return {self._viewing: viewing}
        if kind not in session.stereo_pictures:
            pair, estimate = session.result.pair, session.result.estimate
            work = partial(write_stereo_picture, pair, estimate, kind, session.folder)
            try:
                session.stereo_pictures[kind] = await self._host.work(request, work, progress)
            except (StereoweaveError, OSError) as error:
                return {self._viewing: self._wording.format_error(error), **self.empty()}
        made = session.stereo_pictures[kind]
        size_mb = made.file.stat().st_size / 1e6
        label = f"Download {made.file.name} ({size_mb:.1f} MB)"
        return {
            self._viewing: viewing,
            self._preview: str(made.shown),
            self._file: gr.update(value=str(made.file), label=label, visible=True),
        }
