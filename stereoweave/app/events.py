"""Long work of the page as Gradio's events, which a button cancels and a closed tab ends."""

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gradio as gr

from stereoweave.app.notices import format_notice
from stereoweave.app.workers import Done, Work, Workers

# Results are kept for an hour.
LIFETIME_S = 3600
# Settings of the events that work on pictures: two visitors' jobs go forward at once. On two cores, two pairs
# at once take as long as one after the other (18 to 33 s and 24 to 34 s, three times), whether each has all
# threads or half of them; with all threads, a pair alone takes half as long.
MATCHING: dict[str, Any] = {"concurrency_id": "matching", "concurrency_limit": 2, "api_visibility": "private"}
# One video at a time, beside the pictures, because a video takes minutes.
VIDEOS: dict[str, Any] = {"concurrency_id": "videos", "concurrency_limit": 1, "api_visibility": "private"}
# One frame of a video takes seconds, so it does not wait for another visitor's video.
STILLS: dict[str, Any] = {"concurrency_id": "stills", "concurrency_limit": 1, "api_visibility": "private"}
# Settings of the events that are answered at once.
AT_ONCE: dict[str, Any] = {"show_progress": "hidden", "concurrency_limit": None, "api_visibility": "private"}
_LOOK_S = 0.2
_CANCELLED = "Cancelled. Change what you like, and start again. A result below is from before."


class Cancelled(Exception):
    """The visitor cancelled the work."""


class CancelButton:
    """Button that cancels a visitor's work of one form.

    Gradio cancels only work that the server knows. The button also stops work that reaches the server later,
    until the visitor begins other work of the form.

    Args:
        element_id: ID of the button's element.
    """

    def __init__(self, element_id: str) -> None:
        self.button = gr.Button("Cancel", variant="stop", interactive=False, elem_id=element_id)
        self._pressed: set[str] = set()

    def is_pressed(self, visitor: str) -> bool:
        """Return whether the visitor has cancelled the work that the button was last switched on for."""
        return visitor in self._pressed

    def forget(self, visitor: str) -> None:
        """Forget a visitor who has left."""
        self._pressed.discard(visitor)

    def switch_on(self, triggers: Sequence[Any]) -> None:
        """Switch the button on at these triggers.

        A browser runs the events of a trigger one after the other, so the button must be switched on before
        the trigger is connected to its work.
        """

        def begin(request: gr.Request) -> Any:
            self._pressed.discard(str(request.session_hash))
            return gr.update(interactive=True)

        for trigger in triggers:
            trigger(begin, None, self.button, **AT_ONCE)

    def connect(
        self,
        status: gr.HTML,
        events: Sequence[Any],
        ends: Sequence[Any],
        others: Mapping[Any, Any] | None = None,
    ) -> None:
        """Let the button cancel these events; it can be pressed while one of them is running or waiting.

        Args:
            status: Shows that the work is cancelled.
            events: The events to cancel.
            ends: Triggers at the end of the work, whether it is cancelled or not.
            others: Content of other parts of the page after cancelling.
        """
        said = f'<div class="cancelled">{format_notice([_CANCELLED])}</div>'
        off, cancelled = {self.button: gr.update(interactive=False)}, {status: said, **(others or {})}

        def press(request: gr.Request) -> dict[Any, Any]:
            self._pressed.add(str(request.session_hash))
            return off | cancelled

        def end(request: gr.Request) -> dict[Any, Any]:
            # Again, because content that the work sent just before may have arrived after that of `press`.
            return off | (cancelled if self.is_pressed(str(request.session_hash)) else {})

        parts = [self.button, *cancelled]
        self.button.click(press, None, parts, cancels=list(events), **AT_ONCE)
        scroll_to(status, [self.button.click])
        for trigger in ends:
            trigger(end, None, parts, **AT_ONCE)


@dataclass(frozen=True)
class Host:
    """What the page's parts share: a folder for results, processes for long work, and the provider."""

    folder: Path
    workers: Workers
    provider: str

    async def work(self, request: gr.Request, work: Work[Done], progress: Any, cancel: CancelButton) -> Done:
        """Do a visitor's work in a process, and show its progress.

        Raises:
            Cancelled: If the visitor pressed the button.
            Exception: As for `Workers.run`.
        """
        async with self.start(request, work, cancel) as job:
            while not await job.is_done():
                if job.what:
                    progress(job.share, desc=job.what)
            return await job.task

    @asynccontextmanager
    async def start(self, request: gr.Request, work: Work[Any], cancel: CancelButton) -> AsyncIterator["Job"]:
        """Do a visitor's work in a process during the block, at whose end it is stopped."""
        visitor = str(request.session_hash)
        job = Job(partial(cancel.is_pressed, visitor))
        job.task = asyncio.create_task(self.workers.run(visitor, work, job.hear))
        try:
            yield job
        finally:
            job.task.cancel()
            await asyncio.gather(job.task, return_exceptions=True)


class Job:
    """Work under way.

    Args:
        is_cancelled: Function that returns whether the visitor has cancelled the work.

    Attributes:
        task: Task whose result is that of the work.
        share, what: The finished share, from 0 to 1, and the name of the step.
    """

    task: asyncio.Task[Any]

    def __init__(self, is_cancelled: Callable[[], bool]) -> None:
        self._is_cancelled = is_cancelled
        self.share, self.what = 0.0, ""

    def hear(self, share: float, what: str) -> None:
        """Keep the progress of the work."""
        self.share, self.what = share, what

    async def is_done(self) -> bool:
        """Wait for a short time, and return whether the work is done or has failed.

        Raises:
            Cancelled: If the visitor has cancelled it, before the call or during it.
        """
        if not self._is_cancelled():
            await asyncio.wait([self.task], timeout=_LOOK_S)
        if self._is_cancelled():
            raise Cancelled
        return self.task.done()


def scroll_to(status: gr.HTML, triggers: Sequence[Any]) -> None:
    """Scroll to the status at these triggers if it is above the window, or below the form on a telephone."""
    look = f"""() => {{
        const status = document.getElementById("{status.elem_id}");
        const top = status.getBoundingClientRect().top;
        if (top < 0 || top > 0.5 * innerHeight)
            status.scrollIntoView({{ behavior: "smooth" }});
    }}"""
    for trigger in triggers:
        trigger(None, None, None, js=look, api_visibility="private")
