"""Fuzzing targets, one per module: generated valid files and a function that reads them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

from stereoweave.errors import StereoweaveError

NAMES = (
    *("pictures", "calibrations", "maps", "pair_lists", "recipes", "shards", "matchers"),
    *("checkpoints", "videos", "marks", "submissions", "service", "connections", "page"),
)


@dataclass(frozen=True, kw_only=True)
class Target:
    """Entry point for untrusted data.

    Attributes:
        starts: Function that generates valid files, by name.
        read: Function that reads a file as the package does. It may raise StereoweaveError; any other error
            is a finding.
        tokens: Words that have a meaning in such files.
        repair: Function that corrects checksums and lengths, so that damage gets past such checks.
    """

    starts: Callable[[], Mapping[str, bytes]]
    read: Callable[[Path], None]
    tokens: tuple[bytes, ...] = ()
    repair: Callable[[bytes], bytes] = bytes


def load(name: str) -> Target:
    """Return the target from a module of this package, or from any other module that defines TARGET."""
    target: Target = import_module(f"{__name__}.{name}" if name in NAMES else name).TARGET
    return target


def read_every_way(*ways: Callable[[], object]) -> None:
    """Read a file in several ways; raise the first StereoweaveError if every way fails."""
    errors = []
    for read in ways:
        try:
            read()
        except StereoweaveError as error:
            errors.append(error)
    if len(errors) == len(ways):
        raise errors[0]


def write_to_bytes(name: str, write: Callable[[Path], object]) -> bytes:
    """Return the bytes that `write` writes to a file of this name."""
    with TemporaryDirectory() as folder:
        path = Path(folder, name)
        write(path)
        return path.read_bytes()
