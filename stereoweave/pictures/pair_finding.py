"""Which pictures are pairs: among a folder's files, by two glob patterns, or by a list; and their names."""

import csv
import glob
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain, repeat, takewhile
from pathlib import Path
from posixpath import splitext
from typing import NamedTuple

from stereoweave.errors import FormatError, Remedy, StereoweaveError
from stereoweave.io.decoding import ENDINGS
from stereoweave.io.files import reading
from stereoweave.io.stores import store_at

BATCH_FILE, SUMMARY_FILE = "batch.json", "summary.csv"
_CALIBRATION = "calib.txt"
_ENDINGS = {
    # Formats that are not read are found as well, so that they are refused by their names.
    "picture": (*ENDINGS, ".heic", ".heif"),
    # Whatever lies beside them: cameras that write .mpo put the left view there as .jpg.
    "both views": (".mpo", ".jps", ".pns"),
    "film": (".mp4", ".mkv", ".mov", ".avi", ".webm"),
}
_SIDES = {"left": "right", "Left": "Right", "LEFT": "RIGHT", "l": "r", "L": "R", "im0": "im1"}
_OTHER_SIDES = _SIDES | {right: left for left, right in _SIDES.items()}
# left, leftImg8bit and imgLeft, but not leftover; a single letter only where a name begins or ends.
_MARK = re.compile(
    r"(?<![A-Za-z])(?:left|right|LEFT|RIGHT)(?![a-z])|(?:Left|Right)(?![a-z])"
    r"|^[lLrR](?=$|[ _.-])|(?<![A-Za-z])[lLrR]$|^im[01]$"
)
_NOT_IN_NAMES = re.compile(r'[<>:"/\\|?*\x00-\x1f]')
# Windows' names of devices, and the files and folders of the batches themselves.
_TAKEN = re.compile(
    r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?|batch\.json|summary\.csv|manifest|plan|begun", re.IGNORECASE
)


@dataclass(frozen=True)
class NamedPair:
    """A pair of a batch, by the name of its results.

    Attributes:
        name: The folder of its results; no other pair of the batch has it.
        pictures: Left and right, or one that holds both.
        calibration: Its own calibration file, where it has one.
    """

    name: str
    pictures: tuple[Path, ...]
    calibration: Path | None = None


class ListedPair(NamedTuple):
    """A pair, or a film, among listed files.

    Attributes:
        name: The folder of its results; no other pair or film among the files has it.
        files: Paths of left and right, of one picture that holds both, or of the film, parted by "/".
        calibration: The path of the pair's own calibration file, where it has one.
    """

    name: str
    files: tuple[str, ...]
    calibration: str | None = None


class Listed(NamedTuple):
    """What is to be worked on among listed files: pairs and films; and pictures that belong to no pair."""

    pairs: list[ListedPair]
    films: list[ListedPair]
    left_out: list[str]


@dataclass(frozen=True)
class FoundPairs:
    """The pairs of a batch, and notes on how they were found."""

    pairs: list[NamedPair]
    notes: tuple[str, ...] = ()


def find_pairs(
    pictures: Sequence[Path], left: str | None, right: str | None, listed: Path | None
) -> FoundPairs | None:
    """The pairs that are given in one of three ways; None for one pair's pictures.

    Args:
        pictures: A folder, or the pictures of one pair.
        left: A glob pattern of the left pictures.
        right: One of the right pictures.
        listed: A list of pairs.

    Raises:
        StereoweaveError: None of the ways was taken or more than one, or as in `pairs_in`, `pairs_by_globs`
            and `pairs_in_list`.
    """
    ways = {"pictures": pictures, "patterns": left or right, "a list": listed}
    given = [way for way, value in ways.items() if value]
    if len(given) != 1 or (left is None) != (right is None):
        found = " with ".join(given) if len(given) != 1 else "one of the two patterns"
        raise StereoweaveError(
            "expected pictures or a folder, patterns of left and right pictures, or a list of pairs, "
            f"found {found or 'none'}",
            remedy=Remedy("give exactly one of them", ("left", "right", "listed")),
        )
    if listed:
        return FoundPairs(pairs_in_list(listed))
    if left and right:
        return FoundPairs(pairs_by_globs(left, right))
    return pairs_in(pictures[0]) if len(pictures) == 1 and pictures[0].is_dir() else None


def pairs_in(folder: Path) -> FoundPairs:
    """The pairs in a folder and below it, as `pairs_among` finds them; the note tells of pictures left out.

    Raises:
        StereoweaveError: No such folder, no picture in it, or two pairs of one name.
    """
    if not folder.is_dir():
        raise StereoweaveError(f"{folder}: expected a folder of pictures, found {_found(folder)}")
    listed = pairs_among(folder, (file.path for file in store_at(folder).files()))
    if not listed.pairs:
        raise StereoweaveError(f"{folder}: expected pictures in it, {_endings()}, found none")
    pairs = [
        NamedPair(
            pair.name,
            tuple(folder / path for path in pair.files),
            folder / pair.calibration if pair.calibration else None,
        )
        for pair in listed.pairs
    ]
    return FoundPairs(pairs, left_out_note(folder, listed.left_out))


def pairs_among(folder: str | Path, paths: Iterable[str]) -> Listed:
    """The pairs and the films among the files of a folder.

    A pair is two pictures whose paths differ in the marks of the sides alone: left/a.png and right/a.png,
    a_L.png and a_R.png, left_01.png and right_01.png, im0.png and im1.png. Where one of the two is missing,
    the pair is there all the same, and cannot be read. Files of both views are pairs by themselves, and so is
    every picture where not one pair was found by marks. A calib.txt beside left.png or im0.png is the pair's.
    Folders that a batch was written to are left out.

    Args:
        folder: Its path or URL; a pair right in it has its name.
        paths: Of the files below it, relative to it and parted by "/", without hidden ones.

    Raises:
        StereoweaveError: Two pairs are of one name.
    """
    files = _by_kind(paths)
    halves, doubles = _pairs_by_marks(files["picture"]), files["both views"]
    rest = sorted(set(files["picture"]).difference(chain.from_iterable(halves)))
    if not (halves or doubles):
        doubles, rest = rest, []
    whole, calibrations = Path(os.path.abspath(folder)).name, set(files[_CALIBRATION])  # noqa: PTH100
    pairs = [ListedPair(_name(path, 1, whole), (path,)) for path in sorted(doubles)]
    for left, right in halves:
        beside = f"{left[: left.rfind('/') + 1]}{_CALIBRATION}"
        calibration = beside if beside in calibrations and _brings_one(left, 2) else None
        pairs.append(ListedPair(_name(left, 2, whole), (left, right), calibration))
    films = [ListedPair(_safe(path), (path,)) for path in sorted(files["film"])]
    _check_names((pair.name, pair.files[0]) for pair in chain(pairs, films))
    return Listed(pairs, films, rest)


def left_out_note(folder: str | Path, pictures: Sequence[str]) -> tuple[str, ...]:
    """A line that tells of the pictures of a folder that belong to no pair; none where there are none."""
    if not pictures:
        return ()
    count = "1 picture" if len(pictures) == 1 else f"{len(pictures)} pictures"
    return (f"{folder}: {count} left out, whose names do not say left or right: {pictures[0]}",)


def pairs_by_globs(left: str, right: str) -> list[NamedPair]:
    """The pairs of the pictures that two patterns find, such as 'left/*.png', each in the order of its names.

    Raises:
        StereoweaveError: A pattern finds nothing, the two find different numbers of files, or two pairs are
            of one name.
    """
    lefts, rights = _matches(left), _matches(right)
    for side, pattern, found in (("left", left, lefts), ("right", right, rights)):
        if not found:
            raise StereoweaveError(
                f"expected pictures that match {pattern}, found none; quote the pattern", setting=side
            )
    if len(lefts) != len(rights):
        raise StereoweaveError(
            f"expected as many left pictures as right ones, found {len(lefts)} for {left} and "
            f"{len(rights)} for {right}"
        )
    fixed = takewhile(lambda part: not re.search(r"[*?\[]", part), Path(left).parent.parts)
    return _named_pairs(zip(lefts, rights, strict=True), Path(*fixed))


def pairs_in_list(path: Path) -> list[NamedPair]:
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
        number: _columns(f"{path}, line {number}", line)
        for number, line in enumerate(lines, 1)
        if line.strip()[:1] not in ("", "#")
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
    return _named_pairs(pictures, path.parent, [row[2] if len(row) == 3 else "" for row in rows.values()])


def _found(path: Path) -> str:
    return "a file" if path.exists() else "no such folder"


def _endings() -> str:
    return ", ".join(sorted((*_ENDINGS["picture"], *_ENDINGS["both views"])))


def _by_kind(paths: Iterable[str]) -> dict[str, list[str]]:
    """What is of use among listed files, by kind; nothing of what is in the folders of other batches."""
    kinds: dict[str, list[str]] = {kind: [] for kind in (*_ENDINGS, BATCH_FILE, _CALIBRATION)}
    kind_of = {ending: kind for kind, endings in _ENDINGS.items() for ending in endings}
    kind_of |= {name: name for name in (BATCH_FILE, _CALIBRATION)}
    for path in paths:
        name = path.rpartition("/")[2]
        if kind := kind_of.get(splitext(name)[1].lower()) or kind_of.get(name):
            kinds[kind].append(path)
    batches = {path.rpartition("/")[0] for path in kinds[BATCH_FILE]}
    if batches:
        kinds = {
            kind: [path for path in of if batches.isdisjoint(_above(path))] for kind, of in kinds.items()
        }
    return kinds


def _above(path: str) -> list[str]:
    """The folders in which a path is; the last is the whole, ""."""
    parts = path.split("/")
    return ["/".join(parts[:count]) for count in reversed(range(len(parts)))]


def _pairs_by_marks(paths: Sequence[str]) -> list[tuple[str, str]]:
    """Left and right, of every path with a mark; none at all where nowhere both are there."""
    there, pairs, settled = set(paths), set(), set()
    for path in paths:
        if path not in settled and (marked := _marked(path)):
            others, is_left = marked
            partner = next((other for other in others if other in there), others[0])
            pairs.add((path, partner) if is_left else (partner, path))
            if partner == others[0]:  # which has this one for its own first choice
                settled.add(partner)
    return sorted(pairs) if any(there.issuperset(pair) for pair in pairs) else []


def _marked(path: str) -> tuple[list[str], bool] | None:
    """What the other side's picture may be called, and whether this one is the left; None without a mark.

    The other's name has every mark of the path changed, or the last alone.
    """
    stem, ending = splitext(path)
    parts = stem.split("/")
    swapped = [_swapped(part) for part in parts]
    places = [place for place, (part, other) in enumerate(zip(parts, swapped, strict=True)) if part != other]
    if not places:
        return None
    last = places[-1]
    others = ["/".join(swapped) + ending]
    if len(places) > 1:
        others.append("/".join((*parts[:last], *swapped[last:])) + ending)
    return others, _MARK.findall(parts[last])[-1] in _SIDES


def _stems(path: str) -> list[str]:
    """The parts of a path, the last without its ending."""
    return splitext(path)[0].split("/")


# Most pictures are in the same folders as the one before them.
@lru_cache(maxsize=1000)
def _swapped(part: str) -> str:
    return _MARK.sub(lambda mark: _OTHER_SIDES[mark[0]], part)


def _matches(pattern: str) -> list[Path]:
    if Path(pattern).is_file():  # whatever its name has in it
        return [Path(pattern)]
    found = sorted(glob.glob(pattern, recursive=True))  # noqa: PTH207 - Path.glob takes no absolute pattern
    return [path for path in map(Path, found) if path.is_file()]


def _columns(where: str, line: str) -> list[str]:
    delimiter = next((character for character in "\t," if character in line), " ")
    try:
        [row] = csv.reader([line.strip()], delimiter=delimiter, skipinitialspace=delimiter == ",")
    except csv.Error as error:
        raise FormatError(f"{where}: expected left, right and perhaps a name, found {error}") from error
    return [column.strip() for column in row if column or delimiter != " "]


def _named_pairs(
    pictures: Iterable[tuple[Path, ...]], root: Path, names: Iterable[str] = repeat("")
) -> list[NamedPair]:
    """A pair for each, called by the name that is given, else by its path below `root` without marks."""
    # Without following links, as `resolve` would: the names are to be those that the user sees.
    above = Path(os.path.abspath(root))  # noqa: PTH100
    pairs = []
    for paths, given in zip(pictures, names, strict=False):
        first = Path(os.path.abspath(paths[0]))  # noqa: PTH100
        below = first.relative_to(above if first.is_relative_to(above) else first.anchor).as_posix()
        name = _safe(given) if given else _name(below, len(paths), above.name)
        beside = paths[0].parent / _CALIBRATION
        # Not Path.exists, which fails where a name is too long.
        is_own = _brings_one(below, len(paths)) and os.path.exists(beside)  # noqa: PTH110
        pairs.append(NamedPair(name, paths, beside if is_own else None))
    _check_names((pair.name, pair.pictures[0]) for pair in pairs)
    return pairs


def _check_names(names: Iterable[tuple[str, str | Path]]) -> None:
    """Refuses two pairs of one name, each told by its first file."""
    seen: dict[str, str | Path] = {}
    for name, file in names:
        # Not every disk tells small letters from capitals.
        other = seen.setdefault(name.casefold(), file)
        if other is not file:
            raise StereoweaveError(
                f"expected pairs of different names, found {name} for {other} and for {file}; rename one",
                remedy=Remedy("or name them in the third column of a list", ("listed",)),
            )


def _name(path: str, pictures: int, whole: str) -> str:
    """The name of a pair by the path of its first picture; the whole folder's where no other is left."""
    parts = _stems(path) if pictures == 1 else list(map(_without_marks, _stems(path)))
    return _safe("_".join(filter(None, parts)) or whole)


@lru_cache(maxsize=1000)
def _without_marks(part: str) -> str:
    return "_".join(filter(None, (piece.strip(" _.-") for piece in _MARK.split(part))))


def _safe(name: str) -> str:
    """The name as every system takes it for a folder beside the files of a batch."""
    name = _NOT_IN_NAMES.sub("_", name).strip(" .") or "pair"
    return f"{name}_" if _TAKEN.fullmatch(name) else name


def _brings_one(path: str, pictures: int) -> bool:
    """Whether a calibration file beside a pair's first picture is the pair's own."""
    return pictures == 2 and _MARK.fullmatch(_stems(path)[-1]) is not None
