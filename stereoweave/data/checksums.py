"""Checksums beside files, as the program sha256sum writes and checks them."""

import hashlib
from collections.abc import Mapping

from stereoweave.errors import FormatError


def make_checksums(files: Mapping[str, bytes]) -> bytes:
    """A line for each file, by name: its SHA-256 and its name; `sha256sum --check` takes it."""
    lines = (f"{hashlib.sha256(files[name]).hexdigest()}  {name}\n" for name in sorted(files))
    return "".join(lines).encode()


def verify_checksums(files: Mapping[str, bytes], sums: bytes, where: object, remedy: str) -> None:
    """FormatError, naming the first file that is not the one that `sums` was made of."""
    found = set(make_checksums(files).splitlines())
    expected = sums.splitlines()
    wrong = [line for line in expected if line not in found]
    if wrong or len(found) != len(expected):
        name = wrong[0].partition(b"  ")[2].decode(errors="replace") if wrong else "a pair"
        raise FormatError(f"{where}: expected {name} as it was written, found it damaged or gone; {remedy}")
