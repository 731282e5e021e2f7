"""Atomic writing of files, and one-line errors for files that cannot be read or written."""

import re
import stat
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from stereoweave.errors import FormatError, Remedy, StereoweaveError, reason

# Real calibrations and training recipes have a few kilobytes.
MOST_SMALL_BYTES = 256 * 1024
# Names of the temporary files of `replacing`: as 255 bytes are the most, they have a part of the stem only.
_LONGEST_STEM = 50
_TEMPORARY = re.compile(r"\..*-[0-9a-f]{8}(\.\w+)?")
_ANOTHER = Remedy("choose another place for the output")
# Errors that libraries raise for damaged files, such as OverflowError for infinite sizes and RuntimeError (as
# RecursionError) for deeply nested JSON.
_UNREADABLE = OSError, ValueError, OverflowError, SyntaxError, RuntimeError


def read_small(path: str | Path) -> bytes:
    """Read a regular file of at most 256 KB, such as a calibration.

    Raises:
        FormatError: The file is larger, or it is a pipe or a device, which may be endless.
        OSError: The file cannot be read; `reading` turns this into a FormatError.
    """
    mode = Path(path).stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):  # opening a folder fails with its own error
        raise FormatError(
            f"{path}: expected a regular file, found a pipe or a device; save its content to a file"
        )
    with Path(path).open("rb") as file:
        content = file.read(MOST_SMALL_BYTES + 1)
    if len(content) > MOST_SMALL_BYTES:
        raise FormatError(
            f"{path}: expected a text file of at most {MOST_SMALL_BYTES} bytes, found more; give another file"
        )
    return content


def make_folder(path: str | Path) -> Path:
    """Create a folder and check at once that it is writable, so that a long run does not fail at its end."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError as error:
        raise StereoweaveError(
            f"{path}: expected a writable folder, found {reason(error)}", remedy=_ANOTHER
        ) from error


def make_parent_folder(*files: Path) -> Path:
    """Check that files in the same folder can be written. Returns the nearest existing parent folder.

    If the folder does not exist yet, this parent is checked instead. Raises StereoweaveError if a file cannot
    be written.
    """
    for file in files:
        if file.is_dir():
            raise StereoweaveError(f"{file}: expected a writable file, found a folder", remedy=_ANOTHER)
    # A dangling link counts as existing, because no folder can be created in its place.
    return make_folder(next(path for path in files[0].parents if path.exists() or path.is_symlink()))


def refuse_inputs(outputs: Iterable[Path], inputs: Iterable[Path], setting: str = "out") -> None:
    """Raise StereoweaveError if an output, named by this setting, would replace an input."""
    given = [path for path in inputs if path.exists()]
    for output in outputs:
        if output.exists() and any(output.samefile(path) for path in given):
            raise StereoweaveError(
                f"{output}: expected a new file, found one of the inputs",
                remedy=Remedy("choose another one", (setting,)),
            )


@contextmanager
def reading(path: str | Path, expected: str) -> Iterator[None]:
    """Turn errors raised while reading `path` into a one-line FormatError: "expected ..., found ..."."""
    try:
        yield
    except FormatError:
        raise
    except _UNREADABLE as error:
        raise FormatError(f"{path}: expected {expected}, found {reason(error)}") from error


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Write a file atomically: yield a temporary path, then move the file from there to `path`.

    The temporary file is in the folder of `path`, has the same extension, and is removed after an error.
    Missing folders are created.

    Raises:
        StereoweaveError: The folder or the file cannot be written.
    """
    target = Path(path)
    stem = target.stem[:_LONGEST_STEM]
    temporary = make_folder(target.parent) / f".{stem}-{uuid4().hex[:8]}{target.suffix}"
    try:
        yield temporary
        temporary.replace(target)
    except OSError as error:
        raise StereoweaveError(f"{path}: expected a writable file, found {reason(error)}") from error
    finally:
        # Removing a file of an invalid name would hide the error.
        with suppress(OSError):
            temporary.unlink()


def is_leftover(path: Path) -> bool:
    """Return whether a file has the kind of name that `replacing` gives to temporary files."""
    return _TEMPORARY.fullmatch(path.name) is not None


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files that killed programs left in a folder and its subfolders.

    No other program may be writing to the folder.
    """
    for path in filter(is_leftover, folder.rglob(".*")):
        if not path.is_dir():
            path.unlink(missing_ok=True)
