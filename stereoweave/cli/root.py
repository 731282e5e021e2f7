"""The command line `stereoweave`: its commands, exit codes and one-line errors."""

import io
import sys
from collections.abc import Sequence
from typing import Annotated

import typer

from stereoweave import __version__
from stereoweave.cli.app import app as page
from stereoweave.cli.batch import batch
from stereoweave.cli.bench import bench
from stereoweave.cli.commands import Commands
from stereoweave.cli.demo import demo
from stereoweave.cli.depth import depth, measure
from stereoweave.cli.live import live
from stereoweave.cli.misuse import describe_misuse
from stereoweave.cli.rig import calibrate, check, rectify
from stereoweave.cli.serve import serve
from stereoweave.cli.synth import synth
from stereoweave.cli.train import export, train
from stereoweave.cli.video import video
from stereoweave.cli.view import view
from stereoweave.errors import StereoweaveError

app = Commands("Compute depth, and views from between or beyond the cameras, from a stereo pair.")
app.add_typer(bench, name="bench")
app.add_typer(synth, name="synth")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command `stereoweave`, and return its exit code; see `run`."""
    return run(app, "stereoweave", arguments)


def run(commands: Commands, program: str, arguments: Sequence[str] | None) -> int:
    """Run a command line, and return its exit code: 2 after an error reported in one line on stderr."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # like stderr, for file names that are not UTF-8
    words = list(sys.argv[1:] if arguments is None else arguments)
    # A program of one command has no name of a command before its arguments.
    has_names = len(commands.registered_commands) > 1
    try:
        given = words or (["--help"] if has_names else [])
        return commands(given, prog_name=program, standalone_mode=False) or 0
    except typer.TyperException as error:
        command = words[0] if words and has_names else None
        message = describe_misuse(error, program, command)
    except (StereoweaveError, OSError) as error:
        message = str(error)
    typer.echo(f"{program}: " + " ".join(message.splitlines()), err=True)
    return 2


def _show_version(wanted: bool) -> bool:
    if wanted:
        typer.echo(f"stereoweave {__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def _stereoweave(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit."),
    ] = False,
) -> None:
    """Handle the options of the command `stereoweave` itself."""


for command in (demo, depth, measure, view, video, live, check, rectify, calibrate, serve, batch):
    app.command()(command)
app.command("app")(page)
app.command()(train)
app.command()(export)
