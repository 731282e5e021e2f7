"""Shards of rendered pairs, with valid or invalid checksums."""

from pathlib import Path

import numpy as np

from fuzz.repairs import repair_shard
from fuzz.targets import Target, write_to_bytes
from fuzz.targets.pictures import eyes
from stereoweave.data.packing import pack
from stereoweave.data.samples import make_sample
from stereoweave.data.shards import Shards, write_shard
from stereoweave.stereo import StereoCamera, StereoPair

_NAME = "box-000000-000000.tar"


def _starts() -> dict[str, bytes]:
    left, right = (eye[:16, :24] for eye in eyes())
    camera = StereoCamera(focal_px=60.0, baseline_m=0.2, cx_px=11.5, cy_px=7.5)
    sample = make_sample(
        StereoPair(left=left, right=right, camera=camera), *np.full((2, *left.shape[:2]), 4, np.float32)
    )
    pair = pack(sample, {0.5: left})
    return {_NAME: write_to_bytes(_NAME, lambda path: write_shard(path.parent, "box", 0, [pair]))}


def _read(path: Path) -> None:
    shards = Shards(path.parent)
    for index in range(shards.count):
        shards[index]
        shards.views(index)


TARGET = Target(
    starts=_starts,
    read=_read,
    tokens=(
        *b".camera.json .sha256 box-000000 null [ { } NaN -1 left.webp view_0.50.webp IDAT VP8L".split(),
        *(b"ustar\x0000", b"ustar  \0", b"\x80", b"0000000\0", b"77777777777\0", bytes(512)),
        *(b'"steps_per_px": ', b'"camera": '),
    ),
    repair=repair_shard,
)
