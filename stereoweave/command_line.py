"""What the commands share: words of the command line, and what they do before they work."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stereoweave.errors import StereoweaveError, needing_extra

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
    from stereoweave.io import calibrated, read_pair, read_side_by_side

    match pictures:
        case [left, right]:
            pair = read_pair(left, right)
        case [both]:
            pair = read_side_by_side(both)
        case _:
            names = " ".join(map(str, pictures))
            raise StereoweaveError(
                f"expected LEFT RIGHT or SIDE_BY_SIDE, one or two pictures, found {len(pictures)}: {names}"
            )
    return calibrated(pair, calib) if calib else pair


def load_matcher(model: str, threads: int | None) -> "Matcher":
    """The matcher that a command was asked for."""
    from stereoweave.matcher import Matcher

    return Matcher(model, threads=threads)


def place_for(*files: Path) -> Path:
    """The nearest folder above files of one folder that is there, tried; an error if a file is a folder."""
    from stereoweave.io import make_folder

    for file in files:
        if file.is_dir():
            raise StereoweaveError(f"{file}: expected a file that can be written, found a folder")
    return make_folder(next(path for path in files[0].parents if path.exists()))


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
