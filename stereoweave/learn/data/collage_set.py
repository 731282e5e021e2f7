"""Collages on disk, in the same shard format as rendered sets, for `stereoweave bench pairs`."""

from collections.abc import Iterator
from pathlib import Path

from stereoweave.data.packing import pack
from stereoweave.data.shards import write_shard
from stereoweave.errors import StereoweaveError
from stereoweave.io.files import make_folder
from stereoweave.io.images import SMALLEST_SIDE_PX
from stereoweave.io.output_lock import lock_output
from stereoweave.learn.data.collage import paint_collage

SET_NAME = "collage"
_PAIRS_A_SHARD = 50


def write_collages(out: Path, pairs: int, seed: int, size_px: tuple[int, int]) -> None:
    """Write the first `pairs` collages of epoch 0 as shards.

    Args:
        out: New or empty folder.
        pairs: Number of pairs.
        seed: Seed of the collages; `sources.VALIDATION_SEED` gives the pairs for validation.
        size_px: Height and width in pixels.

    Raises:
        StereoweaveError: A side is too small, or the folder is not empty or not writable.
    """
    if min(size_px) < SMALLEST_SIDE_PX:
        raise StereoweaveError(
            f"expected at least {SMALLEST_SIDE_PX}x{SMALLEST_SIDE_PX} pixels, "
            f"found {size_px[1]}x{size_px[0]}",
            setting="size_px",
        )
    make_folder(out)
    with lock_output(out):
        if any(out.glob("[!.]*")):
            raise StereoweaveError(
                f"{out}: expected a new or empty folder, found files in it; choose another folder"
            )
        for first in range(0, pairs, _PAIRS_A_SHARD):
            numbers = range(first, min(first + _PAIRS_A_SHARD, pairs))
            write_shard(out, SET_NAME, first, list(_pack_collages(seed, numbers, size_px)))


def _pack_collages(seed: int, numbers: range, size_px: tuple[int, int]) -> Iterator[dict[str, bytes]]:
    for number in numbers:
        yield pack(paint_collage(seed, 0, number, *size_px), views={})
