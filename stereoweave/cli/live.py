"""The command `stereoweave live`."""

import os
import time
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from stereoweave.arguments import check_choice
from stereoweave.cli.options import Model, OldFormat, Provider, Threads, replace_old_option
from stereoweave.errors import Remedy, StereoweaveError

Sources = Annotated[
    list[str],
    typer.Argument(
        metavar="SOURCE",
        help="Camera number, video file, stream URL, or picture sequence such as frame%03d.png, with both "
        "views in each frame; a video file with both views in two streams or in turn, or a spatial video; or "
        "two sources, LEFT RIGHT.",
    ),
]
Format = Annotated[
    str | None,
    typer.Option(
        "--format",
        help="Frame packing, such as side_by_side or top_bottom_half (default: as the file says, else "
        "detected in the first frame). An unknown name lists them all.",
    ),
]
Calib = Annotated[
    Path | None,
    typer.Option(help="Calibration file, to rectify the frames and to show metres."),
]
Port = Annotated[
    int, typer.Option(min=0, max=65535, help="Port of the page, on this machine only; 0 takes any free port.")
]
Loop = Annotated[bool, typer.Option("--loop", help="Begin a video file again at its end.")]
Browser = Annotated[bool, typer.Option(help="Open the page in the browser.")]


def live(  # noqa: PLR0913 - each is an option of the command line
    sources: Sources,
    format: Format = None,
    calib: Calib = None,
    model: Model = "small",
    threads: Threads = None,
    provider: Provider = "cpu",
    port: Port = 8123,
    browser: Browser = True,
    loop: Loop = False,
    arrangement: OldFormat = None,
) -> None:
    """Show live video and its depth in colour on a web page. Ctrl-C stops it.

    At the end of a video file, its last picture stays on the page.
    """
    # Otherwise, FFmpeg would print its own message in addition to our error.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    from stereoweave.app.capture import Capture
    from stereoweave.app.live import LiveTally, show
    from stereoweave.app.screen import Screen
    from stereoweave.cameras.calibration_files import read_rig
    from stereoweave.matching.backend import Backend
    from stereoweave.video.packings import FRAME_PACKINGS

    format = replace_old_option(("--arrangement", arrangement), ("--format", format))
    if format is not None:
        check_choice("format", format, FRAME_PACKINGS)
        if len(sources) > 1:
            raise StereoweaveError(
                f"expected a single source with both views, found {' '.join(sources)}",
                setting="format",
                remedy=Remedy("omit this setting"),
            )
    rig = read_rig(calib) if calib else None
    matcher, tally = Backend(model=model, threads=threads, provider=provider).matcher(), LiveTally()
    with Screen(port) as screen, Capture(sources, loop=loop, format=format) as capture:
        typer.echo(f"{capture.name}: shown at {screen.url}; Ctrl-C stops it")
        if browser:
            webbrowser.open(screen.url)
        with suppress(KeyboardInterrupt):
            try:
                show(
                    capture,
                    screen,
                    matcher,
                    tally,
                    format=format,
                    rig=rig,
                    tell=lambda note: typer.echo(str(note)),
                )
            finally:
                typer.echo(f"{capture.name}: {tally.describe()}")
            typer.echo("end of the video; its last picture stays on the page until Ctrl-C")
            while True:
                time.sleep(3600)
