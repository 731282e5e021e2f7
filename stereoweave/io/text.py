"""Texts and tables that every reader takes, whatever names of files are in them."""

import csv
import re
import unicodedata
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from stereoweave.io.files import replacing

# What spreadsheets take for a formula (OWASP, "CSV Injection"); and the mark itself, so that different names
# stay different.
_COMPUTED = ("=", "+", "-", "@", "\t", "\r", "\n", "'")
# Where a spreadsheet may begin a cell: its language sets what it splits at, and quotes inside a cell do not
# keep it from that.
_CELL_STARTS = re.compile(r"(?<=[;\t\r\n])(?![\t\r\n])")
_NUMBER = re.compile(r"-([0-9.]+(e[-+]?[0-9]+)?|inf)")


@contextmanager
def writing_text(path: str | Path) -> Iterator[TextIO]:
    r"""A UTF-8 text file to write to, with no line ends translated; it is whole in the end or not there.

    Bytes of a name that are no UTF-8 stand there as Python writes them: gr\udcfcn for b"gr\xfcn".
    """
    with (
        replacing(path) as temporary,
        temporary.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file,
    ):
        yield file


def write_table(path: str | Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Writes a CSV file with a header; a text that a spreadsheet would compute has a ' before it."""
    with writing_text(path) as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows({column: _inert(value) for column, value in row.items()} for row in rows)


def _inert(value: Any) -> Any:
    if not isinstance(value, str) or _NUMBER.fullmatch(value):
        return value
    return "".join(f"'{cell}" if _is_computed(cell) else cell for cell in _CELL_STARTS.split(value))


def _is_computed(cell: str) -> bool:
    """Whether it begins with a mark of formulas, also of full width (＝) or after blanks."""
    return cell.startswith(_COMPUTED) or unicodedata.normalize("NFKC", cell).lstrip().startswith(_COMPUTED)
