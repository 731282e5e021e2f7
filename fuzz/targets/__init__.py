"""What is fuzzed, a module each: valid files made by rule, and what reads them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

from stereoweave.errors import StereoweaveError

NAMES = (
    *("pictures", "calibrations", "maps", "pair_lists", "recipes", "shards", "matchers"),
    *("checkpoints", "videos", "service", "connections", "page"),
)


@dataclass(frozen=True, kw_only=True)
class Target:
    """A way in.

    Attributes:
        starts: Makes valid files, by their names.
        read: Reads a file as the package does; a StereoweaveError is an answer, anything else a finding.
        tokens: Words that mean something in such files.
        repair: Makes checksums and the like fit again, so that damage gets past them.
    """

    starts: Callable[[], Mapping[str, bytes]]
    read: Callable[[Path], None]
    tokens: tuple[bytes, ...] = ()
    repair: Callable[[bytes], bytes] = bytes


def load(name: str) -> Target:
    """The target of a module in this package, or of any other module that has a TARGET."""
    target: Target = import_module(f"{__name__}.{name}" if name in NAMES else name).TARGET
    return target


def read_every_way(*ways: Callable[[], object]) -> None:
    """Reads a file in several ways; the first one's StereoweaveError where all have one."""
    errors = []
    for read in ways:
        try:
            read()
        except StereoweaveError as error:
            errors.append(error)
    if len(errors) == len(ways):
        raise errors[0]


def written(name: str, write: Callable[[Path], object]) -> bytes:
    """The bytes of the file that `write` writes, which has that name."""
    with TemporaryDirectory() as folder:
        path = Path(folder, name)
        write(path)
        return path.read_bytes()
