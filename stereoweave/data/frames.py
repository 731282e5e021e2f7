"""Frames of a dataset: their names, and the folders that their files are listed from."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.stereo import Sample

_SUFFIXES = {".png", ".webp", ".jpg", ".pfm"}


@dataclass(frozen=True, kw_only=True)
class Frame:
    """A pair of a dataset, known by name and read when it is asked for.

    Attributes:
        name: Unique and stable, parts separated by "/"; what stands before the last "/" is the sequence.
        read: The sample, from its files; FormatError, naming the file, where one is missing or damaged.
    """

    name: str
    read: Callable[[], Sample]

    @property
    def sequence(self) -> str:
        """What stands before the last "/" of the name; empty for stills."""
        return self.name.rpartition("/")[0]


def match_files(*folders: Path, ending: str = "") -> dict[str, list[Path]]:
    """The files of each frame, one from each folder, by the name that they share there, in its order.

    A name is the path below the folder, without the suffix; `ending` is what it must end in to count.

    Raises:
        StereoweaveError: There is no such folder.
        FormatError: A folder lacks a file that another one has.
    """
    listings = [_list_files(folder, ending) for folder in folders]
    names = sorted(set().union(*listings))
    for folder, files in zip(folders, listings, strict=True):
        missing = [name for name in names if name not in files]
        if missing:
            suffix = next((path.suffix for path in files.values()), "")
            raise FormatError(
                f"{folder / missing[0]}{suffix}: expected a file, as in the folders beside it, found none; "
                f"{len(missing)} of {len(names)} are missing there"
            )
    return {name: [files[name] for files in listings] for name in names}


def require_folder(folder: Path) -> Path:
    """The folder itself; StereoweaveError where there is none."""
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing of that name"
        raise StereoweaveError(f"{folder}: expected a folder of the dataset, found {found}")
    return folder


def list_scene_folders(root: Path) -> list[Path]:
    """The folders in `root`, by name, for datasets that keep each scene in one."""
    return sorted(path for path in require_folder(root).iterdir() if path.is_dir() and path.name[0] != ".")


def _list_files(folder: Path, ending: str) -> dict[str, Path]:
    paths = (
        path for path in require_folder(folder).rglob("*") if path.suffix in _SUFFIXES and path.name[0] != "."
    )
    files = {path.relative_to(folder).with_suffix("").as_posix(): path for path in paths}
    return {name: path for name, path in files.items() if name.endswith(ending)}
