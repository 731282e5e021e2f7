"""Replacement of all files of a result in a folder together."""

import os
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
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
    to the same result. All other files are taken to be the user's and are kept. The files of a result all
    have the same time of change, by which they are recognised.

    Args:
        out: Folder of the result; made if it is missing.
        names: All files that a result can have.
        written: The files that this result may have. One that exists and is not of an earlier result is an
            error.
        marks: The files by which an earlier result is recognised: it has the first and, if there are more,
            one of the others. Empty for a folder in which all files are of earlier results.

    Raises:
        OutputInUseError: Another process writes to `out`.
        StereoweaveError: `out` or one of the files cannot be written, or would replace a file of the user's.
    """
    standing = make_parent_folder(*(out / name for name in names))
    _refuse_others(out, set(written) - find_result(out, names, marks))
    with tempfile.TemporaryDirectory(prefix=".stereoweave-", dir=standing) as folder:
        yield Path(folder)
        fresh = [name for name in names if Path(folder, name).exists()]
        now_ns = time.time_ns()
        for name in fresh:
            with suppress(PermissionError):  # of a mounted disk whose files belong to another user
                os.utime(Path(folder, name), ns=(now_ns, now_ns))
        # Without the lock, two commands could leave a mixture of their files.
        with lock_output(make_folder(out)):
            earlier = find_result(out, names, marks)
            for name in fresh:
                Path(folder, name).replace(out / name)
            for name in earlier.difference(fresh):
                (out / name).unlink(missing_ok=True)


def find_result(out: Path, names: Sequence[str], marks: Sequence[str]) -> set[str]:
    """Return the files of the result in a folder; see `replacing_together`."""
    changed_ns = {}
    for name in names:
        with suppress(FileNotFoundError):
            changed_ns[name] = (out / name).stat().st_mtime_ns
    if not marks:
        return {*changed_ns}
    found = {name for name, at_ns in changed_ns.items() if at_ns == changed_ns.get(marks[0])}
    return found if len(marks) == 1 or found.intersection(marks[1:]) else set()


def _refuse_others(out: Path, names: Iterable[str]) -> None:
    """Raise StereoweaveError if `out` has one of these files."""
    for name in sorted(names):
        if (out / name).exists():
            raise StereoweaveError(
                f"{out / name}: expected no file, or one of an earlier result, "
                "found a file of another origin",
                remedy=Remedy("choose another folder", ("out",)),
            )
