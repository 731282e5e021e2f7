"""Marks in the paths of pictures that tell the left one of a pair from the right one."""

import re
from collections.abc import Sequence
from functools import lru_cache
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


def strip_marks(path: str) -> list[str]:
    """Return the parts of a path without their marks and without the file extension."""
    parts = splitext(path)[0].split("/")
    mark = next((mark for mark in _MARKS if any(map(mark.search, parts))), _MARKS[-1])
    return [_strip_marks(mark, part) for part in parts]


def _pair_by_mark(mark: re.Pattern[str], paths: Sequence[str]) -> list[tuple[str, str]]:
    there, pairs, settled = set(paths), set(), set()
    by_stem = {splitext(path)[0]: path for path in paths}
    for path in paths:
        stem, ending = splitext(path)
        if path not in settled and (marked := _swap_sides(mark, stem)):
            others, is_left = marked
            found = (other + ending if other + ending in there else by_stem.get(other) for other in others)
            partner = next(filter(None, found), others[0] + ending)
            pairs.add((path, partner) if is_left else (partner, path))
            if partner == others[0] + ending:  # the partner's own first choice is this path
                settled.add(partner)
    return sorted(pairs) if any(there.issuperset(pair) for pair in pairs) else []


def _swap_sides(mark: re.Pattern[str], stem: str) -> tuple[list[str], bool] | None:
    """Return the other picture's possible paths, and whether this picture is the left one.

    All paths lack the file extension. The other path has all marks swapped, or only the last mark. Return
    None if the path has no marks.
    """
    parts = stem.split("/")
    swapped = [_swap_marks(mark, part) for part in parts]
    places = [place for place, (part, other) in enumerate(zip(parts, swapped, strict=True)) if part != other]
    if not places:
        return None
    last = places[-1]
    others = ["/".join(swapped)]
    if len(places) > 1:
        others.append("/".join((*parts[:last], *swapped[last:])))
    return others, mark.findall(parts[last])[-1] in _SIDES


# Cached, because most pictures are in the same folder as the previous one.
@lru_cache(maxsize=1000)
def _swap_marks(mark: re.Pattern[str], part: str) -> str:
    return mark.sub(lambda found: _OTHER_SIDES[found[0]], part)


@lru_cache(maxsize=1000)
def _strip_marks(mark: re.Pattern[str], part: str) -> str:
    return "_".join(filter(None, (piece.strip(" _.-") for piece in mark.split(part))))
