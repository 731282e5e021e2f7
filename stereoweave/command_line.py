"""What the commands share: words of the command line, and what they do before they work."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stereoweave.errors import needing_extra

if TYPE_CHECKING:
    from stereoweave.matcher import Matcher
    from stereoweave.stereo import StereoPair

Pictures = Annotated[
    list[Path],
    typer.Argument(
        metavar="PICTURE",
        help="LEFT RIGHT, rectified and of one size; or one picture with both side by side.",
    ),
]
Strength = Annotated[
    float, typer.Option(min=0, help="Multiplies the distance of the cameras, about their middle.")
]
Model = Annotated[str, typer.Option(help="The name of a shipped network, or an .onnx file.")]
Threads = Annotated[int | None, typer.Option(min=1, help="Processor threads; as many as cores unless given.")]


def read_pictures(pictures: list[Path], calib: Path | None = None) -> "StereoPair":
    """The pair of the pictures that a command was given, with its camera where there is a calibration."""
    from stereoweave.preparing import Request, prepare

    return prepare(pictures, Request(calibration=calib)).pair


def load_matcher(model: str, threads: int | None) -> "Matcher":
    """The matcher that a command was asked for."""
    from stereoweave.matcher import Matcher

    return Matcher(model, threads=threads)


def place_for(*files: Path) -> Path:
    """As `io.place_for`, which is imported where it is needed alone."""
    from stereoweave import io

    return io.place_for(*files)


@contextmanager
def needing_the_train_extra(what: str = "this command needs PyTorch and its company") -> Iterator[None]:
    """Turns the lack of a library into one line that names the extra."""
    with needing_extra("train", what):
        yield


@contextmanager
def needing_the_synth_extra() -> Iterator[None]:
    """As `needing_the_train_extra`."""
    with needing_extra("synth", "this command needs what renders"):
        yield
