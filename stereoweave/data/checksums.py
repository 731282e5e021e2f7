"""Checksums in the format of sha256sum."""

import hashlib
from collections.abc import Mapping

from stereoweave.errors import FormatError


def make_checksums(files: Mapping[str, bytes]) -> bytes:
    """Return one line per file with its SHA-256 and name, sorted by name, for `sha256sum --check`."""
    lines = (f"{hashlib.sha256(files[name]).hexdigest()}  {name}\n" for name in sorted(files))
    return "".join(lines).encode()


def verify_checksums(files: Mapping[str, bytes], sums: bytes, where: object, remedy: str) -> None:
    """Raise a FormatError if a file is damaged, missing or not listed in `sums`."""
    found = set(make_checksums(files).splitlines())
    expected = sums.splitlines()
    wrong = [line for line in expected if line not in found]
    if wrong or len(found) != len(expected):
        name = wrong[0].partition(b"  ")[2].decode(errors="replace") if wrong else "a pair"
        raise FormatError(f"{where}: expected {name} to be intact, found it damaged or missing; {remedy}")
