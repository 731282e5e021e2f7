"""The command stereoweave live."""

import os
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from stereoweave.cli.options import Model, Provider, Threads, naming_video_options
from stereoweave.errors import StereoweaveError

Sources = Annotated[
    list[str],
    typer.Argument(
        metavar="SOURCE",
        help="A camera's number, a video file, the address of a stream, or pictures as frame%03d.png, with "
        "both views in each frame; or LEFT RIGHT.",
    ),
]
Arrangement = Annotated[
    str | None,
    typer.Option(
        help="How a frame holds both views, such as side_by_side or top_bottom_half; guessed from the first "
        "one unless given. Any other word lists them all."
    ),
]
Calib = Annotated[
    Path | None,
    typer.Option(help="A calibration of both cameras: it rectifies what they see, and gives metres."),
]
Port = Annotated[
    int, typer.Option(min=0, max=65535, help="Of the page, on this machine alone; 0 takes any that is free.")
]
Browser = Annotated[bool, typer.Option(help="Open the page in the browser.")]


@naming_video_options()
def live(  # noqa: PLR0913 - each is a word of the command line
    sources: Sources,
    arrangement: Arrangement = None,
    calib: Calib = None,
    model: Model = "small",
    threads: Threads = None,
    provider: Provider = "cpu",
    port: Port = 8123,
    browser: Browser = True,
) -> None:
    """What cameras see and its depth in colours, as it comes, on a page in the browser; Ctrl-C ends it."""
    # Else the libraries that OpenCV reads with tell the terminal in their words what the error says in ours.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    from stereoweave.app.live import Capture, LiveTally, Screen, show
    from stereoweave.cameras.calibration_files import read_rig
    from stereoweave.matching.backend import Backend
    from stereoweave.pictures.frame_packing import ARRANGEMENTS

    if arrangement not in (None, *ARRANGEMENTS) or (arrangement and len(sources) > 1):
        raise StereoweaveError(
            f"--arrangement: expected {', '.join(ARRANGEMENTS)}, of one source with both views, found "
            f"{arrangement} of {' '.join(sources)}"
        )
    rig = read_rig(calib) if calib else None
    matcher, tally = Backend(model=model, threads=threads, provider=provider).matcher(), LiveTally()
    with Screen(port) as screen, Capture(sources) as capture:
        typer.echo(f"{capture.name}: shown at {screen.url}; Ctrl-C ends it")
        if browser:
            webbrowser.open(screen.url)
        try:
            with suppress(KeyboardInterrupt):
                show(capture, screen, matcher, tally, arrangement=arrangement, rig=rig)
        finally:
            typer.echo(f"{capture.name}: {tally.line()}")
