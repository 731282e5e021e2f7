"""Which pictures are pairs: in a folder, by two glob patterns, or by a list; and what each pair is called."""

import csv
import glob
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import repeat, takewhile
from pathlib import Path

from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io import reading

BATCH_FILE, SUMMARY_FILE = "batch.json", "summary.csv"
# These hold both views, whatever lies beside them: cameras that write .mpo put the left view there as .jpg.
_OF_BOTH_VIEWS = {".mpo", ".jps", ".pns"}
# Formats that are not read are found as well, so that they are refused by their names.
_PICTURES = {
    *(".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".gif", ".jp2", ".pgm", ".ppm"),
    *(".heic", ".heif", ".avif"),
}
_SIDES = {"left": "right", "Left": "Right", "LEFT": "RIGHT", "l": "r", "L": "R", "im0": "im1"}
_OTHER_SIDES = _SIDES | {right: left for left, right in _SIDES.items()}
# left, leftImg8bit and imgLeft, but not leftover; a single letter only where a name begins or ends.
_MARK = re.compile(
    r"(?<![A-Za-z])(?:left|right|LEFT|RIGHT)(?![a-z])|(?:Left|Right)(?![a-z])"
    r"|^[lLrR](?=$|[ _.-])|(?<![A-Za-z])[lLrR]$|^im[01]$"
)
_NOT_IN_NAMES = re.compile(r'[<>:"/\\|?*\x00-\x1f]')
# Windows' names of devices, and the files of the batch itself.
_TAKEN = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?|batch\.json|summary\.csv", re.IGNORECASE)


@dataclass(frozen=True)
class Job:
    """A pair of a batch.

    Attributes:
        name: The folder of its results; no other pair of the batch has it.
        pictures: Left and right, or one that holds both.
        calibration: Its own calibration file, where it has one.
    """

    name: str
    pictures: tuple[Path, ...]
    calibration: Path | None = None


@dataclass(frozen=True)
class Pairs:
    """The pairs of a batch, and lines to tell about how they were found."""

    jobs: list[Job]
    notes: tuple[str, ...] = ()


def find_pairs(
    pictures: Sequence[Path], left: str | None, right: str | None, listed: Path | None
) -> Pairs | None:
    """The pairs that the words of a command line name in one of three ways; None for one pair's pictures.

    Args:
        pictures: A folder, or the pictures of one pair.
        left: A glob pattern of the left pictures.
        right: One of the right pictures.
        listed: A list of pairs.

    Raises:
        StereoweaveError: None of the ways was taken or more than one, or as in `pairs_in`, `pairs_by_globs`
            and `pairs_in_list`.
    """
    words = {"pictures": pictures, "--left and --right": left or right, "--list": listed}
    given = [word for word, value in words.items() if value]
    if len(given) != 1 or (left is None) != (right is None):
        found = " with ".join(given) if len(given) != 1 else "one of the two patterns"
        raise StereoweaveError(
            f"expected pictures or a folder, or --left and --right, or --list, found {found or 'none'}"
        )
    if listed:
        return Pairs(pairs_in_list(listed))
    if left and right:
        return Pairs(pairs_by_globs(left, right))
    return pairs_in(pictures[0]) if len(pictures) == 1 and pictures[0].is_dir() else None


def pairs_in(folder: Path) -> Pairs:
    """The pairs in a folder and below it; the note tells of pictures there that belong to none.

    A pair is two pictures whose paths differ in the marks of the sides alone: left/a.png and right/a.png,
    a_L.png and a_R.png, left_01.png and right_01.png, im0.png and im1.png. Where one of the two is missing,
    the pair is there all the same, and cannot be read. Files of both views are pairs by themselves, and so is
    every picture where not one pair was found by marks. A calib.txt beside left.png or im0.png is the pair's.
    Hidden files, and folders that a batch was written to, are left out.

    Raises:
        StereoweaveError: No such folder, no picture in it, or two pairs of one name.
    """
    if not folder.is_dir():
        raise StereoweaveError(f"{folder}: expected a folder of pictures, found {_found(folder)}")
    batches = {path.parent for path in folder.rglob(BATCH_FILE)}
    paths = [path for path in sorted(folder.rglob("*")) if _is_picture(path, folder, batches)]
    doubles = [path for path in paths if path.suffix.lower() in _OF_BOTH_VIEWS]
    halves = [path.relative_to(folder) for path in paths if path.suffix.lower() not in _OF_BOTH_VIEWS]
    pairs = _pairs_by_marks(halves)
    rest = sorted(set(halves) - {half for pair in pairs for half in pair})
    if not (pairs or doubles):
        doubles, rest = [folder / half for half in rest], []
    pictures = [(path,) for path in doubles] + [(folder / left, folder / right) for left, right in pairs]
    if not pictures:
        raise StereoweaveError(f"{folder}: expected pictures in it, {_endings()}, found none")
    return Pairs(_jobs(pictures, folder), _left_out(folder, rest))


def pairs_by_globs(left: str, right: str) -> list[Job]:
    """The pairs of the pictures that two patterns find, such as 'left/*.png', each in the order of its names.

    Raises:
        StereoweaveError: A pattern finds nothing, the two find different numbers of files, or two pairs are
            of one name.
    """
    lefts, rights = _matches(left), _matches(right)
    for option, pattern, found in (("--left", left, lefts), ("--right", right, rights)):
        if not found:
            raise StereoweaveError(f"{option} {pattern}: expected pictures, found none; is it quoted?")
    if len(lefts) != len(rights):
        raise StereoweaveError(
            f"expected as many left pictures as right ones, found {len(lefts)} for --left {left} and "
            f"{len(rights)} for --right {right}"
        )
    fixed = takewhile(lambda part: not re.search(r"[*?\[]", part), Path(left).parent.parts)
    return _jobs(zip(lefts, rights, strict=True), Path(*fixed))


def pairs_in_list(path: Path) -> list[Job]:
    """The pairs of a text file, one a line: left, right, and, where it is to be another, the pair's name.

    Between them are tabs, commas or spaces; what has such in it stands in double quotes. A picture of both
    views stands alone, or with an empty second column before its name. Paths are relative to the list's
    folder. Empty lines, and lines that begin with #, say nothing.

    Raises:
        FormatError: No such file, no text, no pair in it, or a line of more than three columns.
        StereoweaveError: Two pairs are of one name.
    """
    with reading(path, "a list of pairs"):
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    rows = {
        number: _columns(line) for number, line in enumerate(lines, 1) if line.strip()[:1] not in ("", "#")
    }
    for number, row in rows.items():
        if not 1 <= len(row) <= 3 or not row[0]:
            raise FormatError(
                f"{path}, line {number}: expected left, right and perhaps a name, found {len(row)} columns: "
                f"{lines[number - 1].strip()}"
            )
    if not rows:
        raise FormatError(f"{path}: expected a pair in each line, found none")
    pictures = [tuple(path.parent / column for column in row[:2] if column) for row in rows.values()]
    return _jobs(pictures, path.parent, [row[2] if len(row) == 3 else "" for row in rows.values()])


def _left_out(folder: Path, rest: Sequence[Path]) -> tuple[str, ...]:
    if not rest:
        return ()
    count = "1 picture" if len(rest) == 1 else f"{len(rest)} pictures"
    return (f"{folder}: {count} left out, whose names do not say left or right: {rest[0]}",)


def _found(path: Path) -> str:
    return "a file" if path.exists() else "no such folder"


def _endings() -> str:
    return ", ".join(sorted(_OF_BOTH_VIEWS | _PICTURES))


def _is_picture(path: Path, folder: Path, batches: set[Path]) -> bool:
    hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
    known = path.suffix.lower() in _OF_BOTH_VIEWS | _PICTURES
    return known and not hidden and path.is_file() and batches.isdisjoint(path.parents)


def _pairs_by_marks(paths: Sequence[Path]) -> list[tuple[Path, Path]]:
    """Left and right, of every path with a mark; none at all where nowhere both are there."""
    there = set(paths)
    pairs = set()
    for path in paths:
        if others := _partners(path):
            partner = next((other for other in others if other in there), others[0])
            pairs.add((path, partner) if _is_left(path) else (partner, path))
    return sorted(pairs) if any(there.issuperset(pair) for pair in pairs) else []


def _partners(path: Path) -> list[Path]:
    """What the other side's picture may be called: with every mark of the path changed, or the last alone."""
    parts = _stems(path)
    marked = [index for index, part in enumerate(parts) if _MARK.search(part)]
    return [
        _with(path, [_swapped(part) if index in chosen else part for index, part in enumerate(parts)])
        for chosen in (marked, marked[-1:])
        if chosen
    ]


def _is_left(path: Path) -> bool:
    last = next(part for part in reversed(_stems(path)) if _MARK.search(part))
    return _MARK.findall(last)[-1] in _SIDES


def _stems(path: Path) -> list[str]:
    return [*path.parent.parts, path.stem]


def _with(path: Path, stems: Sequence[str]) -> Path:
    return Path(*stems[:-1], stems[-1] + path.suffix)


def _swapped(part: str) -> str:
    return _MARK.sub(lambda mark: _OTHER_SIDES[mark[0]], part)


def _matches(pattern: str) -> list[Path]:
    if Path(pattern).is_file():  # whatever its name has in it
        return [Path(pattern)]
    found = sorted(glob.glob(pattern, recursive=True))  # noqa: PTH207 - Path.glob takes no absolute pattern
    return [path for path in map(Path, found) if path.is_file()]


def _columns(line: str) -> list[str]:
    delimiter = next((character for character in "\t," if character in line), " ")
    [row] = csv.reader([line.strip()], delimiter=delimiter, skipinitialspace=delimiter == ",")
    return [column.strip() for column in row if column or delimiter != " "]


def _jobs(pictures: Iterable[tuple[Path, ...]], root: Path, names: Iterable[str] = repeat("")) -> list[Job]:
    """A job for each pair, called by the name that is given, else by its path below `root` without marks."""
    jobs: dict[str, Job] = {}
    for paths, given in zip(pictures, names, strict=False):
        job = Job(_safe(given or _name(paths, root)), paths, _calibration(paths))
        # Not every disk tells small letters from capitals.
        other = jobs.setdefault(job.name.casefold(), job)
        if other is not job:
            raise StereoweaveError(
                f"expected pairs of different names, found {job.name} for {other.pictures[0]} and for "
                f"{paths[0]}; name them in the third column of a --list"
            )
    return list(jobs.values())


def _name(pictures: Sequence[Path], root: Path) -> str:
    # Without following links, as `resolve` would: the names are to be those that the user sees.
    first, above = (Path(os.path.abspath(path)) for path in (pictures[0], root))  # noqa: PTH100
    below = first.relative_to(above if first.is_relative_to(above) else first.anchor)
    parts = _stems(below) if len(pictures) == 1 else list(map(_without_marks, _stems(below)))
    return "_".join(filter(None, parts)) or above.name


def _without_marks(part: str) -> str:
    return "_".join(filter(None, (piece.strip(" _.-") for piece in _MARK.split(part))))


def _safe(name: str) -> str:
    """The name as every system takes it for a folder beside the files of a batch."""
    name = _NOT_IN_NAMES.sub("_", name).strip(" .") or "pair"
    return f"{name}_" if _TAKEN.fullmatch(name) else name


def _calibration(pictures: Sequence[Path]) -> Path | None:
    beside = pictures[0].with_name("calib.txt")
    return beside if len(pictures) == 2 and _MARK.fullmatch(pictures[0].stem) and beside.exists() else None
