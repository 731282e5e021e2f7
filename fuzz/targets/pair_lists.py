"""Lists of pairs, as read by `depth --list`."""

from pathlib import Path

from fuzz.targets import Target
from stereoweave.pictures.pair_finding import read_pair_list

_STARTS = {
    "spaces.txt": b"left/a.png right/a.png\n# a comment\n\nleft/b.png right/b.png second\n",
    "commas.csv": b'"left one.png", right.png, first\n"both.mpo",,second\n',
    "tabs.tsv": "\ufeffl/ä.png\tr/ä.png\tdrei\nl/b.png\tr/b.png\n".encode(),
    "alone.txt": b"one.mpo\ntwo.jps\n",
}


def _read(path: Path) -> None:
    read_pair_list(path)


TARGET = Target(
    starts=_STARTS.copy,
    read=_read,
    tokens=(
        *b', " "" \0 ../ / # \xff \xed\xa0\x80 \\ nul batch.json left.png ~'.split(),
        *(b"\t", b" ", b"\n", b"\r", b"\x0c", b"\x1c", "\u2028".encode(), "\u0085".encode()),
    ),
)
