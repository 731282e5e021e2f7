"""Shared by the tests of sets on disk: pairs that are quickly made and have exact ground truth."""

import os
import signal
import time
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from stereoweave.data.samples import make_sample
from stereoweave.stereo import Sample, StereoCamera, StereoPair
from stereoweave.synth.sets.pair_rendering import RenderedPair, RenderSpec
from stereoweave.synth.world import RenderedView

# f B = 12 px m: the box of `box_before_a_wall` is at 1.2 m, its wall at 4 m.
CAMERA = StereoCamera(focal_px=60.0, baseline_m=0.2, cx_px=23.5, cy_px=15.5)
WALL_PX, BOX_PX = 3, 10


def box_before_a_wall(rng: np.random.Generator, size_px: tuple[int, int] = (48, 32)) -> Sample:
    """Return a wall below a sky, with a box in front in the middle third of the left columns and rows."""
    width, height = size_px
    left_px, right_px = (np.full((height, width), WALL_PX, np.float32) for _ in range(2))
    rows, start, end = slice(height // 3, 2 * height // 3), width // 3, 2 * width // 3
    left_px[rows, start:end] = BOX_PX
    right_px[rows, start - BOX_PX : end - BOX_PX] = BOX_PX
    for disparity_px in (left_px, right_px):
        disparity_px[: height // 4] = 0
    surface = rng.integers(0, 256, (height, width + BOX_PX, 3), dtype=np.uint8)
    box = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    left, right = surface[:, :width].copy(), surface[:, WALL_PX : WALL_PX + width].copy()
    right[: height // 4] = left[: height // 4]
    left[rows, start:end] = right[rows, start - BOX_PX : end - BOX_PX] = box[rows, start:end]
    return make_sample(StereoPair(left=left, right=right, camera=CAMERA), left_px, right_px)


@dataclass(frozen=True)
class PaintedPairMaker:
    """Maker of pairs without rendering, which kills this process or halts its parent at a given pair."""

    dies_at: int | None = None
    halts_at: int | None = None

    def renderer(self) -> str:
        return "paint"

    def __call__(self, spec: RenderSpec, index: int) -> RenderedPair:
        if index == self.dies_at:
            os.kill(os.getpid(), signal.SIGKILL)
        if index == self.halts_at:
            os.kill(os.getppid(), signal.SIGSTOP)
            time.sleep(600)
        sample = box_before_a_wall(np.random.default_rng((spec.seed, index)), spec.size_px)
        shot = RenderedView(image=sample.right, depth_m=sample.disparity_px, target=sample.occluded)
        views = tuple((position, shot) for position in spec.views)
        return RenderedPair(sample=sample, views=views)


def contents(folder: Path) -> dict[str, bytes]:
    """Read all files in a folder and its subfolders."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def assert_equal(found: Sample, made: Sample) -> None:
    for field in fields(Sample):
        np.testing.assert_array_equal(
            getattr(found, field.name), getattr(made, field.name), err_msg=field.name
        )
