"""The file that a user probably meant by the name of a missing one."""

import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

_MOST_FILES = 10_000


def as_typed(path: Path) -> str:
    """Return a path as the user typed it: an address has two slashes, of which a path keeps one."""
    return re.sub(r"^(https?):/+", r"\1://", str(path))


def describe_missing(path: Path) -> str:
    """Return what was found in place of a missing file, with the file that was probably meant, if any."""
    if re.match(r"https?:/", str(path)):
        return "an address; download the file first, because nothing is fetched"
    if re.search(r"[*?]", path.name):
        return "no file that matches"
    if not path.parent.is_dir():
        return f"no such file, and no folder {path.parent}"
    meant = next(_find_similar(path), None)
    return "no such file" if meant is None else f"no such file; did you mean {meant}?"


def _find_similar(path: Path) -> Iterator[Path]:
    """Yield files beside a missing one whose name is the same but for a slip."""
    try:
        beside = sorted(islice(path.parent.iterdir(), _MOST_FILES))
    except OSError:
        return
    yield from (other for other in beside if _is_slip(path.name, other.name) and other.is_file())


def _is_slip(typed: str, name: str) -> bool:
    """Return whether two names differ in case, extension, two swapped letters or one missing letter alone.

    Other letters and digits distinguish pictures: a_L.png is not a_R.png, and 1.png is not 11.png.
    """
    typed, name = typed.lower(), name.lower()
    if typed == name or Path(typed).stem == Path(name).stem:
        return True
    if len(typed) == len(name):
        places = [place for place, pair in enumerate(zip(typed, name, strict=True)) if pair[0] != pair[1]]
        swapped = [typed[place] for place in reversed(places)] == [name[place] for place in places]
        return len(places) == 2 and places[1] == places[0] + 1 and swapped and _are_letters(typed, *places)
    shorter, longer = sorted((typed, name), key=len)
    extra = [place for place in range(len(longer)) if longer[:place] + longer[place + 1 :] == shorter]
    return len(shorter) > 3 and bool(extra) and _are_letters(longer, extra[0])


def _are_letters(text: str, *places: int) -> bool:
    return all(text[place].isalpha() for place in places)
