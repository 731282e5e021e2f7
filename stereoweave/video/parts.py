"""Parts of an unfinished video on disk, from which an interrupted conversion resumes."""

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from av.error import FFmpegError

from stereoweave.errors import NameOf, StereoweaveError, keyword
from stereoweave.io.files import make_folder, remove_leftovers, replacing


class Parts:
    """Finished parts of a video, and the state of the conversion after the last part.

    Attributes:
        folder: Folder that contains the parts.
        files: Paths of the finished parts, in order.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.files = sorted(folder.glob("[0-9]*.nut"))
        if not self._state_file(len(self.files)).exists():  # `_clear` was interrupted
            self.files = []

    @contextmanager
    def next(self, state: Callable[[], Mapping[str, np.ndarray]]) -> Iterator[Path]:
        """Yield a path for the next part, which counts as finished once the state after it is also saved."""
        number = len(self.files) + 1
        part = self.folder / f"{number:06}.nut"
        with replacing(part) as temporary:
            yield temporary
            with replacing(self._state_file(number)) as state_file:
                np.savez(state_file, allow_pickle=False, **state())
        self.files.append(part)
        self._state_file(number - 1).unlink(missing_ok=True)

    def state(self) -> dict[str, np.ndarray]:
        """Load the state after the last finished part."""
        file = self._state_file(len(self.files))
        with _reporting_damage(file), file.open("rb") as opened, np.load(opened) as arrays:
            return dict(arrays)

    def _state_file(self, number: int) -> Path:
        return self.folder / f"state-{number:06}.npz"


def parts_folder(out: Path) -> Path:
    """Return the folder for the parts of an unfinished video."""
    return out.with_name(f"{out.name}.parts")


@contextmanager
def open_parts(out: Path, settings: Mapping[str, object], name_of: NameOf = keyword) -> Iterator[Parts]:
    """Open the parts of a video so that more parts can be added.

    On success, all parts are removed. After an error, the finished parts are kept.

    Args:
        out: The video that the parts will become.
        settings: Input and settings of the conversion, as JSON values.
        name_of: Function that returns the front end's name for a setting, used in error messages.

    Raises:
        StereoweaveError: The folder contains damaged parts, or parts made with other settings. Also raised if
            the block fails after a part was finished; the message then says how to resume.
    """
    folder = parts_folder(out)
    parts = Parts(folder)
    if parts.files:
        _check_settings(folder, settings, name_of)
        parts.state()
        remove_leftovers(folder)
    else:
        _clear(folder)
    make_folder(folder)
    try:
        if not parts.files:
            with replacing(_settings_file(folder)) as file:
                file.write_text(json.dumps(settings, indent=2))
        yield parts
    except BaseException as error:
        if not parts.files:
            _clear(folder)
        elif isinstance(error, OSError | FFmpegError | StereoweaveError):
            ours = error if isinstance(error, StereoweaveError) else StereoweaveError(str(error))
            raise ours.with_detail(
                f"finished parts are in {folder}; rerun the same command to resume"
            ) from error
        raise
    _clear(folder)


def _settings_file(folder: Path) -> Path:
    return folder / "settings.json"


def _clear(folder: Path) -> None:
    """Remove the parts from a folder, and then the folder if it is empty."""
    for file in chain(folder.glob("*.npz"), folder.glob("*.nut"), [_settings_file(folder)]):
        file.unlink(missing_ok=True)
    with suppress(OSError):
        folder.rmdir()


def _check_settings(folder: Path, settings: Mapping[str, object], name_of: NameOf) -> None:
    file = _settings_file(folder)
    with _reporting_damage(file):
        found = dict(json.loads(file.read_text()))
    current = json.loads(json.dumps(settings))
    other = [name for name in current | found if current.get(name) != found.get(name)]
    if other:
        begun = ", ".join(_format_setting(name_of(name) or name, found.get(name)) for name in other)
        raise StereoweaveError(
            f"{folder}: expected parts made with the current settings, found parts made {begun}; "
            "remove this folder, or rerun with the same settings"
        )


def _format_setting(name: str, value: object) -> str:
    match value:
        case None | False:
            return f"without {name}"
        case True:
            return f"with {name}"
        case str() | int() | float():
            return f"with {name} {value}"
        case _:
            return f"with another {name}"


@contextmanager
def _reporting_damage(file: Path) -> Iterator[None]:
    """Convert any error from reading a file in the folder of parts to a one-line StereoweaveError."""
    try:
        yield
    except (OSError, ValueError, TypeError, EOFError, BadZipFile) as error:
        raise StereoweaveError(
            f"{file}: expected the saved state of an interrupted conversion, found no readable file; "
            f"remove the folder {file.parent}"
        ) from error
