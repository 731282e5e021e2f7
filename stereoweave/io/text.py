"""Text files and CSV tables that are valid and safe to open, whatever file names they contain."""

import csv
import re
import unicodedata
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from stereoweave.io.files import replacing

# Beginnings of formulas in spreadsheets (OWASP, "CSV Injection"), and the apostrophe that marks text: if
# apostrophes were not escaped too, two names could become equal.
_COMPUTED = ("=", "+", "-", "@", "\t", "\r", "\n", "'")
# Places where a spreadsheet may begin a cell: the separator depends on its language, and quotes within a cell
# do not prevent a split.
_CELL_STARTS = re.compile(r"(?<=[;\t\r\n])(?![\t\r\n])")
_NUMBER = re.compile(r"-([0-9.]+(e[-+]?[0-9]+)?|inf)")


@contextmanager
def writing_text(path: str | Path) -> Iterator[TextIO]:
    r"""Write a UTF-8 text file atomically, without translating line endings.

    Bytes of a file name that are not valid UTF-8 are escaped as in Python: gr\udcfcn for b"gr\xfcn".
    """
    with (
        replacing(path) as temporary,
        temporary.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file,
    ):
        yield file


def write_table(path: str | Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write a CSV file with a header; text that a spreadsheet would evaluate gets a leading apostrophe."""
    with writing_text(path) as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows({column: _escape_formulas(value) for column, value in row.items()} for row in rows)


def _escape_formulas(value: Any) -> Any:
    if not isinstance(value, str) or _NUMBER.fullmatch(value):
        return value
    return "".join(f"'{cell}" if _is_computed(cell) else cell for cell in _CELL_STARTS.split(value))


def _is_computed(cell: str) -> bool:
    """Return whether a cell begins like a formula, even with a full-width sign (＝) or leading spaces."""
    return cell.startswith(_COMPUTED) or unicodedata.normalize("NFKC", cell).lstrip().startswith(_COMPUTED)
