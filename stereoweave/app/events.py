"""Long work of the page as Gradio's events, which a button cancels and a closed tab ends."""

import asyncio
from collections.abc import AsyncIterator, Sequence
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
_LOOK_S = 0.2
_CANCELLED = "Cancelled. Change what you like, and start again. A result below is from before."


@dataclass(frozen=True)
class Host:
    """What the page's parts share: a folder for results, processes for long work, and the provider."""

    folder: Path
    workers: Workers
    provider: str

    async def work(self, request: gr.Request, work: Work[Done], progress: Any) -> Done:
        """Do a visitor's work in a process, and show its progress. Raises the errors of `Workers.run`."""
        return await self.workers.run(str(request.session_hash), work, partial(_show_progress, progress))

    @asynccontextmanager
    async def start(self, request: gr.Request, work: Work[Any]) -> AsyncIterator["Job"]:
        """Do a visitor's work in a process during the block, at whose end it is stopped."""
        job = Job()
        job.task = asyncio.create_task(self.workers.run(str(request.session_hash), work, job.hear))
        try:
            yield job
        finally:
            job.task.cancel()
            await asyncio.gather(job.task, return_exceptions=True)


class Job:
    """Work under way.

    Attributes:
        task: Task whose result is that of the work.
        share, what: The finished share, from 0 to 1, and the name of the step.
    """

    task: asyncio.Task[Any]

    def __init__(self) -> None:
        self.share, self.what = 0.0, ""

    def hear(self, share: float, what: str) -> None:
        """Keep the progress of the work."""
        self.share, self.what = share, what

    async def is_done(self) -> bool:
        """Wait for a short time, and return whether the work is done or has failed."""
        await asyncio.wait([self.task], timeout=_LOOK_S)
        return self.task.done()


def connect_cancel(cancel: gr.Button, status: gr.HTML, events: Sequence[Any]) -> None:
    """Let a button cancel these events; it can be pressed while one of them is running or waiting."""
    cancel.click(
        lambda: (f'<div class="cancelled">{format_notice([_CANCELLED])}</div>', gr.update(interactive=False)),
        None,
        [status, cancel],
        cancels=list(events),
        concurrency_limit=None,
        api_visibility="private",
    )
    scroll_to(status, [cancel.click])


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


def switch(cancel: gr.Button, triggers: Sequence[Any], *, on: bool) -> None:
    """Switch the button to cancel on or off at these triggers.

    A browser runs the events of a trigger one after the other, so the button must be switched on before the
    trigger is connected to its work.
    """
    for trigger in triggers:
        trigger(
            partial(gr.update, interactive=on),
            None,
            cancel,
            show_progress="hidden",
            concurrency_limit=None,
            api_visibility="private",
        )


def _show_progress(progress: Any, share: float, what: str) -> None:
    progress(share, desc=what)
