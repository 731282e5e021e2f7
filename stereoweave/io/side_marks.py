"""Marks in the paths of pictures that tell the left one of a pair from the right one."""

import re
from collections.abc import Sequence
from functools import lru_cache
from itertools import chain, takewhile, zip_longest
from posixpath import splitext

_SIDES = {"left": "right", "Left": "Right", "LEFT": "RIGHT", "l": "r", "L": "R", "im0": "im1"}
_SIDES |= {"cam0": "cam1", "Cam0": "Cam1", "CAM0": "CAM1"}
_OTHER_SIDES = _SIDES | {right: left for left, right in _SIDES.items()}
# The later ones are marks only in paths without the earlier ones, because cam0_left.png is a left picture.
_MARKS = (
    # Matches left, leftImg8bit and imgLeft, but not leftover; matches a single letter only at the start or
    # the end of a name.
    re.compile(
        r"(?<![A-Za-z])(?:left|right|LEFT|RIGHT)(?![a-z])|(?:Left|Right)(?![a-z])"
        r"|^[lLrR](?=$|[ _.-])|(?<![A-Za-z])[lLrR]$|^im[01]$"
    ),
    re.compile(r"(?<![A-Za-z])(?:cam|Cam|CAM)[01](?![A-Za-z0-9])"),
    re.compile(r"(?<![A-Za-z])[lLrR](?=[0-9 _.-])"),
)


def pair_by_marks(paths: Sequence[str]) -> list[tuple[str, str]]:
    """Pair the paths that contain a mark, as (left, right); return an empty list if no pair is complete.

    Two paths are a pair if they differ only in their marks and file extensions. A path without a partner is
    paired with a path that is not among `paths`. Numbers of cameras are marks only if no pair is complete
    without them, and letters within a name only if none is complete without these. The separator is "/".
    """
    return next(filter(None, (_pair_by_mark(mark, paths) for mark in _MARKS)), [])


def strip_marks(path: str, partner: str | None = None) -> list[str]:
    """Return the parts of a path without the file extension and its marks.

    Marks that the other picture has, too, stay: right_wing_L and right_wing_R are right_wing.
    """
    parts = splitext(path)[0].split("/")
    others = splitext(partner)[0].split("/") if partner else []
    if len(others) != len(parts):
        mark = next((mark for mark in _MARKS if any(map(mark.search, parts))), _MARKS[-1])
        return [_strip_marks(mark, part) for part in parts]
    unlike = (mark for mark in _MARKS if [*map(mark.findall, parts)] != [*map(mark.findall, others)])
    mark = next(unlike, _MARKS[-1])
    return [_strip_unlike_marks(mark, *both) for both in zip(parts, others, strict=True)]


def _pair_by_mark(mark: re.Pattern[str], paths: Sequence[str]) -> list[tuple[str, str]]:
    there, pairs, settled = set(paths), set(), set()
    by_stem = {splitext(path)[0]: path for path in paths}

    def find(others: Sequence[str], ending: str) -> str | None:
        found = (other + ending if other + ending in there else by_stem.get(other) for other in others)
        return next(filter(None, found), None)

    for path in paths:
        stem, ending = splitext(path)
        if path in settled or not (marked := _swap_sides(mark, stem)):
            continue
        others, is_left = marked
        partner = find(others, ending)
        if partner is None:
            partner = others[-1] + ending
        elif by_stem.keys().isdisjoint(_list_nearer(mark, partner, stem)):
            settled.add(partner)
        else:  # the partner belongs to a nearer path, so this path's own partner is missing
            partner = others[0] + ending
        pairs.add((path, partner) if is_left else (partner, path))
    return sorted(pairs) if any(there.issuperset(pair) for pair in pairs) else []


def _list_nearer(mark: re.Pattern[str], path: str, stem: str) -> list[str]:
    """Return the possible partners of a path that are likelier than the one with this stem."""
    others, _ = _swap_sides(mark, splitext(path)[0]) or ([], False)
    return list(takewhile(lambda other: other != stem, others))


def _swap_sides(mark: re.Pattern[str], stem: str) -> tuple[list[str], bool] | None:
    """Return the other picture's possible paths, likeliest first, and whether this one is the left one.

    All paths lack the file extension. The other path has only the last mark swapped, all marks of the last
    part that has any, or all marks. Return None if the path has no marks.
    """
    parts = stem.split("/")
    swapped = [_swap_marks(mark, part) for part in parts]
    places = [place for place, (part, other) in enumerate(zip(parts, swapped, strict=True)) if part != other]
    if not places:
        return None
    last = places[-1]
    *_, found = mark.finditer(parts[last])
    nearest = parts[last][: found.start()] + _OTHER_SIDES[found[0]] + parts[last][found.end() :]
    others = ["/".join((*parts[:last], part, *parts[last + 1 :])) for part in (nearest, swapped[last])]
    return [*others, "/".join(swapped)], found[0] in _SIDES


# Cached, because most pictures are in the same folder as the previous one.
@lru_cache(maxsize=1000)
def _swap_marks(mark: re.Pattern[str], part: str) -> str:
    return mark.sub(lambda found: _OTHER_SIDES[found[0]], part)


@lru_cache(maxsize=1000)
def _strip_marks(mark: re.Pattern[str], part: str) -> str:
    return "_".join(filter(None, (piece.strip(" _.-") for piece in mark.split(part))))


def _strip_unlike_marks(mark: re.Pattern[str], part: str, other: str) -> str:
    """Return a part without the marks that differ from those of the other path's part."""
    own, others = mark.findall(part), mark.findall(other)
    if len(own) != len(others):
        return _strip_marks(mark, part)
    kept = ["/" if mine != other_mark else mine for mine, other_mark in zip(own, others, strict=True)]
    text = "".join(chain.from_iterable(zip_longest(mark.split(part), kept, fillvalue="")))
    return "_".join(filter(None, (piece.strip(" _.-") for piece in text.split("/"))))
