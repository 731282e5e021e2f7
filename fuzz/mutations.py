"""Random damage to valid files: changed bytes, lengths and numbers, deep nesting, parts of other files."""

import re
from collections.abc import Callable, Sequence
from random import Random

# A larger case would take as much time as many small ones, and findings are committed to git.
MOST_BYTES = 200_000
_MOST_CHANGES = 6
_COUNTS = (*[1] * 10, 2, 2, 3, 20, 1000, 40_000)
_FILLS = (0x00, 0x20, 0x7F, 0x80, 0xFF)
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_NUMBERS = (
    *b"0 -0 1 -1 2 3 0.5 1e-320 1e308 -1e308 1e999 nan .nan inf -inf .inf x 0x10".split(),
    *b"127 255 32767 65535 65536 2147483647 2147483648 -2147483648 4294967296 9223372036854775808".split(),
    *(b"9" * 400, b"9" * 5000, b""),
)
_LENGTHS = (0, 1, 2, 3, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)


def mutate(content: bytes, others: Sequence[bytes], tokens: Sequence[bytes], rng: Random) -> bytes:
    """Return a damaged copy of `content`, at most MOST_BYTES long.

    Args:
        content: Bytes of a file.
        others: Other files of the same kind, from which parts may be spliced in.
        tokens: Words that have a meaning in such files.
        rng: Source of randomness.
    """
    changes: list[Callable[[bytes, Random], bytes]] = [
        *(_flip_bits, _fill, _overwrite_length, _cut_off, _remove, _repeat, _swap, _change_number),
        lambda before, rng: _splice(before, rng.choice(others), rng),
        lambda before, rng: _insert(before, rng.choice(tokens or (b"\0",)), rng),
    ]
    # Most cases differ little from a valid file, so that the reader gets far into them.
    for _ in range(min(1 + int(rng.expovariate(0.7)), _MOST_CHANGES)):
        content = rng.choice(changes)(content, rng)[:MOST_BYTES]
    return content


def _flip_bits(content: bytes, rng: Random) -> bytes:
    changed = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 8)) if changed else 0):
        changed[_place(changed, rng)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _fill(content: bytes, rng: Random) -> bytes:
    start, end = _run(content, rng)
    return content[:start] + bytes([rng.choice(_FILLS)]) * (end - start) + content[end:]


def _overwrite_length(content: bytes, rng: Random) -> bytes:
    """Write a number to a random place, which may hold a length, an offset or a count."""
    width = rng.choice((1, 2, 4, 8))
    value = rng.choice((*_LENGTHS, len(content), rng.randrange(1 << 16))) % (1 << 8 * width)
    start = _place(content, rng)
    number = value.to_bytes(width, rng.choice(("big", "little")))
    return content[:start] + number + content[start + width :]


def _cut_off(content: bytes, rng: Random) -> bytes:
    return content[: _place(content, rng)]


def _remove(content: bytes, rng: Random) -> bytes:
    start, end = _run(content, rng)
    return content[:start] + content[end:]


def _repeat(content: bytes, rng: Random) -> bytes:
    start, end = _run(content, rng)
    return _with_many(content, end, content[start:end], rng)


def _swap(content: bytes, rng: Random) -> bytes:
    """Swap two adjacent parts."""
    start, middle, end = sorted(_place(content, rng) for _ in range(3))
    return content[:start] + content[middle:end] + content[start:middle] + content[end:]


def _change_number(content: bytes, rng: Random) -> bytes:
    found = list(_NUMBER.finditer(content))
    if not found:
        return _flip_bits(content, rng)
    start, end = rng.choice(found).span()
    return content[:start] + rng.choice(_NUMBERS) + content[end:]


def _splice(content: bytes, other: bytes, rng: Random) -> bytes:
    """Join the beginning of one file to the end of another, or replace a part with one of the other."""
    if rng.random() < 0.5:
        return content[: _place(content, rng)] + other[_place(other, rng) :]
    (start, end), (first, last) = _run(content, rng), _run(other, rng)
    return content[:start] + other[first:last] + content[end:]


def _insert(content: bytes, token: bytes, rng: Random) -> bytes:
    return _with_many(content, _place(content, rng), token, rng)


def _with_many(content: bytes, place: int, part: bytes, rng: Random) -> bytes:
    """Insert a part one or more times, sometimes often enough to make a recursive parser nest deeply."""
    count = min(rng.choice(_COUNTS), MOST_BYTES // max(len(part), 1))
    return content[:place] + part * count + content[place:]


def _place(content: bytes | bytearray, rng: Random) -> int:
    """Draw a random place in the content. Half of all draws are in the header, which describes the rest."""
    most = max(len(content), 1)
    return rng.randrange(min(most, 64) if rng.random() < 0.5 else most)


def _run(content: bytes, rng: Random) -> tuple[int, int]:
    """Draw the start and end of a random part; short and long parts are equally likely."""
    start = _place(content, rng)
    return start, min(start + (1 << rng.randrange(max(len(content), 2).bit_length())), len(content))
