"""Frames of a dataset, and matching of their files by name."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.stereo import Sample

_SUFFIXES = {".png", ".webp", ".jpg", ".pfm"}


@dataclass(frozen=True, kw_only=True)
class Frame:
    """A stereo pair in a dataset, read on request.

    Attributes:
        name: Unique and stable name, SEQUENCE/FRAME; the sequence may contain "/" or be absent.
        read: Function that reads the sample; it raises a FormatError if a file is missing or damaged.
    """

    name: str
    read: Callable[[], Sample]

    @property
    def sequence(self) -> str:
        """The part of the name before the last "/"; empty for stills."""
        return self.name.rpartition("/")[0]


def match_files(*folders: Path, ending: str = "") -> dict[str, list[Path]]:
    """Match the files in several folders by name; return one file per folder for each name, sorted by name.

    A name is the path relative to the folder, without the file extension. Names that do not end in `ending`
    are ignored.

    Raises:
        StereoweaveError: A folder does not exist.
        FormatError: A folder lacks a file that another folder has.
    """
    listings = [_list_files(folder, ending) for folder in folders]
    names = sorted(set().union(*listings))
    for folder, files in zip(folders, listings, strict=True):
        missing = [name for name in names if name not in files]
        if missing:
            suffix = next((path.suffix for path in files.values()), "")
            raise FormatError(
                f"{folder / missing[0]}{suffix}: expected a file, as in the other folders, found none; "
                f"{len(missing)} of {len(names)} files are missing from this folder"
            )
    return {name: [files[name] for files in listings] for name in names}


def require_folder(folder: Path) -> Path:
    """Return the folder; raise a StereoweaveError if it does not exist."""
    if not folder.is_dir():
        found = "a file" if folder.exists() else "no such folder"
        raise StereoweaveError(f"{folder}: expected a dataset folder, found {found}")
    return folder


def list_scene_folders(root: Path) -> list[Path]:
    """List the folders in `root`, sorted by name, for datasets with one folder per scene."""
    return sorted(path for path in require_folder(root).iterdir() if path.is_dir() and path.name[0] != ".")


def _list_files(folder: Path, ending: str) -> dict[str, Path]:
    paths = (
        path for path in require_folder(folder).rglob("*") if path.suffix in _SUFFIXES and path.name[0] != "."
    )
    files = {path.relative_to(folder).with_suffix("").as_posix(): path for path in paths}
    return {name: path for name, path in files.items() if name.endswith(ending)}
