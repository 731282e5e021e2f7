"""Replacement of all files of a result in a folder together."""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from stereoweave.errors import Remedy, StereoweaveError
from stereoweave.io.files import make_folder, make_parent_folder
from stereoweave.io.output_lock import lock_output


@contextmanager
def replacing_together(
    out: Path, names: Sequence[str], written: Sequence[str], marks: Sequence[str]
) -> Iterator[Path]:
    """Yield a temporary folder whose files are moved to `out` at the end; an error leaves `out` unchanged.

    Files of an earlier result that the new result lacks are removed, so that all output files in `out` belong
    to the same result. In a folder without an earlier result, files with these names are taken to be the
    user's and are kept.

    Args:
        out: Folder of the result; made if it is missing.
        names: All files that a result can have.
        written: The files that this result has. One that exists without an earlier result is an error.
        marks: The files by which an earlier result is recognised: it has the first and, if there are more,
            one of the others. Empty for a folder in which all files are of earlier results.

    Raises:
        OutputInUseError: Another process writes to `out`.
        StereoweaveError: `out` or one of the files cannot be written, or would replace a file of the user's.
    """
    standing = make_parent_folder(*(out / name for name in names))
    if not _has_result(out, marks):
        _refuse_others(out, written)
    with tempfile.TemporaryDirectory(prefix=".stereoweave-", dir=standing) as folder:
        yield Path(folder)
        # Without the lock, two commands could leave a mixture of their files.
        with lock_output(make_folder(out)):
            is_earlier_result = _has_result(out, marks)
            # The marks first, so that a result is recognised even if this process is killed in between.
            for name in sorted(names, key=lambda name: name not in marks):
                fresh = Path(folder, name)
                if fresh.exists():
                    fresh.replace(out / name)
                elif is_earlier_result:
                    (out / name).unlink(missing_ok=True)


def _has_result(out: Path, marks: Sequence[str]) -> bool:
    there = [(out / name).exists() for name in marks]
    return not there or (there[0] and (len(there) == 1 or any(there[1:])))


def _refuse_others(out: Path, written: Sequence[str]) -> None:
    """Raise StereoweaveError if `out` has one of the files to write."""
    for name in written:
        if (out / name).exists():
            raise StereoweaveError(
                f"{out / name}: expected no file, or one of an earlier result, "
                "found a file of another origin",
                remedy=Remedy("choose another folder", ("out",)),
            )
