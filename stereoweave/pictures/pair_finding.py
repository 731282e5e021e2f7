"""Finding and naming the pairs of a batch: in a folder, by two glob patterns, or from a list."""

import csv
import glob
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, repeat, takewhile
from pathlib import Path, PurePosixPath
from posixpath import splitext
from typing import NamedTuple

from stereoweave.errors import FormatError, Remedy, StereoweaveError
from stereoweave.io import raw
from stereoweave.io.decoding import ENDINGS
from stereoweave.io.files import reading
from stereoweave.io.side_marks import pair_by_marks, strip_marks
from stereoweave.io.stores import store_at

BATCH_FILE, SUMMARY_FILE = "batch.json", "summary.csv"
_CALIBRATION = "calib.txt"
_ENDINGS = {
    "picture": tuple(ENDINGS),
    # These are pairs even if there are pictures beside them, because cameras also write an .mpo file's left
    # view as .jpg.
    "both views": (".mpo", ".jps", ".pns"),
    # Other programs use .raw for anything.
    "raw": tuple(raw.ENDINGS - {".raw"}),
    "film": (".mp4", ".mkv", ".mk3d", ".mov", ".avi", ".webm"),
}
# The pictures among the files of a single result, by the file that every such result has.
_RESULTS = {
    "disparity.pfm": (
        *("disparity.png", "disparity_scaled.png", "disparity.tiff", "depth.png", "depth.tiff"),
        *("preview.png", "confidence.png", "occluded.png", "matched_left.png"),
    ),
    "distance.pfm": ("distance_preview.png", "distance_confidence.png", "panorama_left.png"),
}
# The name, without extension, that `view` gives to a file: the left picture's, and then the layout's.
_VIEW = re.compile(
    r"(.+)_(?:view|side_by_side|crossed|top_bottom|anaglyph|rgbd|quilt|contact_sheet|sweep|wiggle)(?:_[^/]*)?"
)
# The file that every result of `rectify` has, and what the folder adds to the name of the left picture.
_RECTIFIED_FILE, _RECTIFIED = "rectified.json", "_rectified"
_NOT_IN_NAMES = re.compile(r'[<>:"/\\|?*\x00-\x1f]')
# Names of Windows devices, and of a batch's own files and folders.
_TAKEN = re.compile(
    r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?|batch\.json|summary\.csv|manifest|plan|begun", re.IGNORECASE
)


@dataclass(frozen=True)
class NamedPair:
    """A pair in a batch.

    Attributes:
        name: Name of the pair and of its results folder, unique in the batch.
        pictures: Left and right picture, or one picture with both views.
        calibration: The pair's own calibration file, if any.
    """

    name: str
    pictures: tuple[Path, ...]
    calibration: Path | None = None


class ListedPair(NamedTuple):
    """A pair or video among listed files.

    Attributes:
        name: Name of the pair or video and of its results folder, unique among the files.
        files: Paths, with "/" as separator, of the left and the right picture, of one picture with both
            views, or of the video.
        calibration: Path of the pair's own calibration file, if any.
    """

    name: str
    files: tuple[str, ...]
    calibration: str | None = None


class Listed(NamedTuple):
    """Pairs, videos and unpaired pictures among listed files."""

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
    """Find the pairs in a folder, by two patterns or in a list; return None if the pictures are one pair.

    Args:
        pictures: A folder, or the pictures of one pair.
        left: Glob pattern of the left pictures.
        right: Glob pattern of the right pictures.
        listed: File with a list of pairs.

    Raises:
        StereoweaveError: Pictures, patterns and the list are all missing, or more than one of them is given;
            see also `find_pairs_in`, `find_pairs_by_globs` and `read_pair_list`.
    """
    ways = {"pictures": pictures, "patterns": left or right, "a list": listed}
    given = [way for way, value in ways.items() if value]
    if len(given) != 1:
        raise StereoweaveError(
            "expected pictures or a folder, patterns of left and right pictures, or a list of pairs, "
            f"found {' and '.join(given) or 'none'}",
            remedy=Remedy("give exactly one of them", ("left", "right", "listed")),
        )
    if (left is None) != (right is None):
        missing = "left" if left is None else "right"
        raise StereoweaveError(
            f"expected patterns of the left and of the right pictures, found none of the {missing} ones",
            remedy=Remedy("give both, or give the pictures themselves", ("left", "right")),
        )
    if len(pictures) == 2 and all(path.is_dir() for path in pictures):
        raise StereoweaveError(
            f"expected two pictures, or one folder of pairs, found two folders: {pictures[0]} {pictures[1]}",
            remedy=Remedy("give a pattern of the pictures in each, such as 'left/*.png'", ("left", "right")),
        )
    if listed:
        return FoundPairs(read_pair_list(listed))
    if left and right:
        return FoundPairs(find_pairs_by_globs(left, right))
    return find_pairs_in(pictures[0]) if len(pictures) == 1 and pictures[0].is_dir() else None


def find_pairs_in(folder: Path) -> FoundPairs:
    """Find the pairs in a folder and its subfolders (`find_pairs_among`).

    A note gives the number of unpaired pictures.

    Raises:
        StereoweaveError: The folder does not exist or has no pictures, or two pairs have the same name.
    """
    if not folder.is_dir():
        raise StereoweaveError(f"{folder}: expected a folder of pictures, found {_describe_found(folder)}")
    listed = find_pairs_among(folder, (file.path for file in store_at(folder).files()))
    if not listed.pairs:
        raise StereoweaveError(f"{folder}: expected a folder with pictures ({_list_endings()}), found none")
    pairs = [
        NamedPair(
            pair.name,
            tuple(folder / path for path in pair.files),
            folder / pair.calibration if pair.calibration else None,
        )
        for pair in listed.pairs
    ]
    return FoundPairs(pairs, note_listing(folder, listed))


def find_pairs_among(folder: str | Path, paths: Iterable[str]) -> Listed:
    """Find the pairs and videos among the files of a folder.

    Two pictures are a pair if their paths differ only in their left/right marks: left/a.png and right/a.png,
    a_L.png and a_R.png, left_01.png and right_01.png, im0.png and im1.png, cam0/a.png and cam1/a.png. Their
    file extensions may differ. If one picture is missing, the pair is still listed, and fails when it is
    read. A file with both views is also a pair. A camera raw file counts only if no picture beside it has its
    name. If there is no such pair or file, every picture is taken to hold both views. A calib.txt beside
    left.png, im0.png or cam0.png belongs to that pair. Output folders of batches, the files of a single
    result, and views of a pair and its rectified pictures beside its left picture are ignored.

    Args:
        folder: Path or URL of the folder; a pair whose name consists only of marks is named after the folder.
        paths: Paths of the files in the folder, relative to it, with "/" as separator and without hidden
            files.

    Raises:
        StereoweaveError: Two pairs have the same name.
    """
    files = _group_by_kind(paths)
    pictures = [*files["picture"], *_find_undeveloped(files["raw"], files["picture"])]
    halves, doubles = pair_by_marks(pictures), files["both views"]
    views = _find_views(halves, pictures)
    halves = [pair for pair in halves if views.isdisjoint(pair)]
    rest = sorted(set(pictures).difference(views, chain.from_iterable(halves)))
    if not (halves or doubles):
        doubles, rest = rest, []
    whole, calibrations = _absolute(folder).name, set(files[_CALIBRATION])
    pairs = [ListedPair(_name_pair((path,), whole), (path,)) for path in sorted(doubles)]
    for left, right in halves:
        beside = f"{left[: left.rfind('/') + 1]}{_CALIBRATION}"
        calibration = beside if beside in calibrations and _owns_calibration(left, 2) else None
        pairs.append(ListedPair(_name_pair((left, right), whole), (left, right), calibration))
    films = [ListedPair(_sanitize(path), (path,)) for path in sorted(files["film"])]
    _check_names((pair.name, pair.files) for pair in chain(pairs, films))
    return Listed(pairs, films, rest)


def note_listing(folder: str | Path, listed: Listed) -> tuple[str, ...]:
    """Return notes on what the names of a folder's pictures mean, where that may not be intended."""
    return (*_note_unmarked(folder, listed.pairs), *_note_left_out(folder, listed.left_out))


def _note_unmarked(folder: str | Path, pairs: Sequence[ListedPair]) -> tuple[str, ...]:
    """Return a note if every picture is taken to hold both views, because none has a side in its name."""
    suffixes = {PurePosixPath(file).suffix.lower() for pair in pairs for file in pair.files}
    in_two = any(len(pair.files) == 2 for pair in pairs)
    if not pairs or in_two or suffixes & {*_ENDINGS["both views"]}:
        return ()
    return (
        f"{folder}: no two names differ in left and right alone, as 1_L.jpg and 1_R.jpg do, so each picture "
        "is taken to hold both views",
    )


def _note_left_out(folder: str | Path, pictures: Sequence[str]) -> tuple[str, ...]:
    """Return a note on a folder's pictures without a partner, if there are any."""
    if not pictures:
        return ()
    count = "1 picture" if len(pictures) == 1 else f"{len(pictures)} pictures"
    return (f"{folder}: {count} skipped, no left or right in the name: {pictures[0]}",)


def find_pairs_by_globs(left: str, right: str) -> list[NamedPair]:
    """Pair the pictures that match two patterns, such as 'left/*.png', by their names without marks.

    If no left picture has such a name in common with a right one, pair them in the order of their names.

    Raises:
        StereoweaveError: A pattern matches nothing, the patterns match different numbers of files, a left
            picture has no partner, or two pairs have the same name.
    """
    lefts, rights = _glob_files(left), _glob_files(right)
    for side, pattern, found in (("left", left, lefts), ("right", right, rights)):
        if not found:
            raise StereoweaveError(
                f"expected pictures that match {pattern}, found none; check and quote the pattern",
                setting=side,
            )
    if len(lefts) != len(rights):
        raise StereoweaveError(
            f"expected as many left pictures as right pictures, found {len(lefts)} for {left} and "
            f"{len(rights)} for {right}"
        )
    left_names, right_names = _name_globbed(left, lefts), _name_globbed(right, rights)
    by_name = dict(zip(right_names, rights, strict=True))
    partners = [by_name.get(name) for name in left_names]
    if any(partners):
        for names, found in ((left_names, lefts), (right_names, rights)):
            _check_names((name, (path,)) for name, path in zip(names, found, strict=True))
    else:
        partners = [*rights]
    pairs = []
    for path, partner in zip(lefts, partners, strict=True):
        if partner is None:
            raise StereoweaveError(
                f"{path}: expected a right picture of this name among those that match {right}, as "
                f"{len(list(filter(None, partners)))} of {len(lefts)} left pictures have, found none",
                remedy=Remedy("add it, or list the pairs in a file", ("listed",)),
            )
        pairs.append((path, partner))
    return _make_pairs(pairs, find_root(left))


def find_root(pattern: str) -> Path:
    """Return the innermost folder that contains all files that match a pattern."""
    return Path(*takewhile(lambda part: not re.search(r"[*?\[]", part), Path(pattern).parent.parts))


def _name_globbed(pattern: str, found: Sequence[Path]) -> list[str]:
    root = _absolute(find_root(pattern))
    return [_join_parts(strip_marks(_path_below(root, path))) for path in found]


def read_pair_list(path: Path) -> list[NamedPair]:
    """Read a list of pairs from a text file, one per line: left, right, and optionally the pair's name.

    Columns are separated by tabs, commas, semicolons or spaces; double quotes protect separators. A picture
    with both views is alone on its line, or followed by an empty second column and its name. Paths are
    relative to the list's folder. Empty lines and lines that begin with # are ignored.

    Raises:
        FormatError: The file is missing, empty or not text, or a line has more than three columns.
        StereoweaveError: Two pairs have the same name.
    """
    with reading(path, "a list of pairs"):
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    rows = {
        number: _split_columns(f"{path}, line {number}", line)
        for number, line in enumerate(lines, 1)
        if line.strip()[:1] not in ("", "#")
    }
    for number, row in rows.items():
        if not 1 <= len(row) <= 3 or not row[0]:
            raise FormatError(
                f"{path}, line {number}: expected the left picture, the right picture and optionally a name, "
                f"found {len(row)} columns: "
                f"{lines[number - 1].strip()}"
            )
    if not rows:
        raise FormatError(f"{path}: expected a list with one pair per line, found no pairs")
    pictures = [tuple(path.parent / column for column in row[:2] if column) for row in rows.values()]
    return _make_pairs(pictures, path.parent, [row[2] if len(row) == 3 else "" for row in rows.values()])


def _describe_found(path: Path) -> str:
    return "a file" if path.exists() else "no such folder"


def _list_endings() -> str:
    return ", ".join(sorted((*_ENDINGS["picture"], *_ENDINGS["both views"])))


def _group_by_kind(paths: Iterable[str]) -> dict[str, list[str]]:
    """Group listed files by kind; drop files of unknown kind and those of batches and of single results."""
    names = (BATCH_FILE, _RECTIFIED_FILE, _CALIBRATION, *_RESULTS)
    kinds: dict[str, list[str]] = {kind: [] for kind in (*_ENDINGS, *names)}
    kind_of = {ending: kind for kind, endings in _ENDINGS.items() for ending in endings}
    kind_of |= {name: name for name in names}
    for path in paths:
        name = path.rpartition("/")[2]
        if kind := kind_of.get(splitext(name)[1].lower()) or kind_of.get(name):
            kinds[kind].append(path)
    batches = {path.rpartition("/")[0] for path in kinds[BATCH_FILE]}
    if batches:
        kinds = {
            kind: [path for path in of if batches.isdisjoint(_list_parents(path))]
            for kind, of in kinds.items()
        }
    made = {
        path.removesuffix(first) + name
        for first, names in _RESULTS.items()
        for path in kinds[first]
        for name in names
    }
    made.update(_find_rectified(kinds))
    kinds["picture"] = [path for path in kinds["picture"] if path not in made]
    return kinds


def _find_undeveloped(raws: Sequence[str], pictures: Sequence[str]) -> list[str]:
    """Return the raw files beside which the camera wrote no picture of the same name."""
    names = {splitext(path)[0] for path in pictures}
    return [path for path in raws if splitext(path)[0] not in names]


def _find_views(halves: Sequence[tuple[str, str]], pictures: Sequence[str]) -> set[str]:
    """Return the pictures that are views of a complete pair; a picture with a partner is none."""
    there = set(pictures)
    whole = [pair for pair in halves if there.issuperset(pair)]
    lefts = {splitext(left)[0] for left, _ in whole}
    unpaired = there.difference(chain.from_iterable(whole))
    return {path for path in unpaired if (view := _VIEW.fullmatch(splitext(path)[0])) and view[1] in lefts}


def _find_rectified(kinds: Mapping[str, Sequence[str]]) -> set[str]:
    """Return the pictures that `rectify` wrote to a folder named after a picture beside the folder."""
    named = {splitext(path)[0] + _RECTIFIED for kind in _ENDINGS for path in kinds[kind]}
    own = named.intersection(mark.rpartition("/")[0] for mark in kinds[_RECTIFIED_FILE])
    return {f"{folder}/{side}.png" for folder in own for side in ("left", "right")}


def _list_parents(path: str) -> list[str]:
    """Return the folders that contain a path, from the innermost to the root, which is an empty string."""
    parts = path.split("/")
    return ["/".join(parts[:count]) for count in reversed(range(len(parts)))]


def _glob_files(pattern: str) -> list[Path]:
    if Path(pattern).is_file():  # even if its name contains wildcards
        return [Path(pattern)]
    found = sorted(glob.glob(pattern, recursive=True))  # noqa: PTH207 - Path.glob refuses absolute patterns
    return [path for path in map(Path, found) if path.is_file()]


def _split_columns(where: str, line: str) -> list[str]:
    outside = re.sub(r'"[^"]*"', "", line)
    delimiter = next((character for character in "\t,;" if character in outside), " ")
    try:
        [row] = csv.reader([line.strip()], delimiter=delimiter, skipinitialspace=delimiter in ",;")
    except csv.Error as error:
        raise FormatError(
            f"{where}: expected the left picture, the right picture and optionally a name, found a line that "
            f"cannot be parsed ({error})"
        ) from error
    return [column.strip() for column in row if column or delimiter != " "]


def _make_pairs(
    pictures: Iterable[tuple[Path, ...]], root: Path, names: Iterable[str] = repeat("")
) -> list[NamedPair]:
    """Create the pairs; a pair's name defaults to its path below `root` without marks."""
    above = _absolute(root)
    pairs = []
    for paths, given in zip(pictures, names, strict=False):
        below = [_path_below(above, path) for path in paths]
        name = _sanitize(given) if given else _name_pair(below, above.name)
        beside = paths[0].parent / _CALIBRATION
        # Not Path.exists, which raises an error if a name is too long.
        is_own = _owns_calibration(below[0], len(paths)) and os.path.exists(beside)  # noqa: PTH110
        pairs.append(NamedPair(name, paths, beside if is_own else None))
    _check_names((pair.name, pair.pictures) for pair in pairs)
    return pairs


def _absolute(path: str | Path) -> Path:
    # Not `resolve`, which follows links; users must recognise the names.
    return Path(os.path.abspath(path))  # noqa: PTH100


def _path_below(above: Path, path: Path) -> str:
    """Return a path relative to an absolute folder, or to the root of the disk if it is elsewhere."""
    path = _absolute(path)
    return path.relative_to(above if path.is_relative_to(above) else path.anchor).as_posix()


def _check_names(names: Iterable[tuple[str, Sequence[str | Path]]]) -> None:
    """Raise a StereoweaveError if two pairs have the same name; `names` gives the name and files of each."""
    seen: dict[str, Sequence[str | Path]] = {}
    for name, files in names:
        # Some file systems ignore case.
        others = seen.setdefault(name.casefold(), files)
        if others is not files:
            unlike = (both for both in zip(others, files, strict=False) if both[0] != both[1])
            first, second = next(unlike, (others[0], files[0]))
            raise StereoweaveError(
                f"expected pairs with different names, found {name} for both {first} and {second}; "
                "rename one",
                remedy=Remedy("or name them in the third column of a list", ("listed",)),
            )


def _name_pair(paths: Sequence[str], whole: str) -> str:
    """Name a pair after its first picture's path without marks, or after the folder if nothing remains."""
    return _join_parts(strip_marks(*paths) if len(paths) == 2 else splitext(paths[0])[0].split("/"), whole)


def _join_parts(parts: Iterable[str], otherwise: str = "") -> str:
    return _sanitize("_".join(filter(None, parts)) or otherwise)


def _sanitize(name: str) -> str:
    """Return a name that is valid for a folder on every system and not taken by a batch's own files."""
    name = _NOT_IN_NAMES.sub("_", name).strip(" .") or "pair"
    return f"{name}_" if _TAKEN.fullmatch(name) else name


def _owns_calibration(path: str, pictures: int) -> bool:
    """Return whether a calibration file beside a pair's first picture belongs to that pair alone."""
    return pictures == 2 and not strip_marks(path)[-1]
