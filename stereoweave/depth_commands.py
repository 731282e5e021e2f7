"""The command stereoweave depth."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stereoweave.command_line import Model, Pictures, Threads, load_matcher

if TYPE_CHECKING:
    from stereoweave.report import Summary


def depth(  # noqa: PLR0913 - each is a word of the command line
    pictures: Pictures,
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder to write the results into.")],
    calib: Annotated[Path | None, typer.Option(help="Middlebury's calib.txt, for depth in metres.")] = None,
    model: Model = "small",
    threads: Threads = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Depth of a stereo pair: maps, pictures of them, and a report to open in a browser."""
    from stereoweave.preparing import Request
    from stereoweave.results import DepthOrder, make_depth

    order = DepthOrder(request=Request(calibration=calib), model=model, threads=threads)
    summary, notes = make_depth(pictures, out, order, load_matcher(model, threads))
    (_tell_json if as_json else _tell)(summary, notes, out)


def _tell_json(summary: "Summary", notes: list[str], out: Path) -> None:
    from stereoweave.results import FILES

    files = {file: str(out / file) for file in FILES if (out / file).exists()}
    typer.echo(json.dumps(asdict(summary) | {"notes": notes, "files": files}, indent=2, allow_nan=False))


def _tell(summary: "Summary", notes: list[str], out: Path) -> None:
    size = f"{summary.width_px}x{summary.height_px} px"
    typer.echo(
        f"{' + '.join(summary.pictures)}: {size}, matched by {summary.model} in {summary.estimate_ms:.0f} ms"
    )
    typer.echo(f"disparity {summary.disparity_min_px:.1f} to {summary.disparity_max_px:.1f} px")
    for note in notes:
        typer.echo(note)
    typer.echo(f"report: {out / 'report.html'}")
