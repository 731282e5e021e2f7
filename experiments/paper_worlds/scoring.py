"""Scores of networks on frames of the worlds that they trained on, and on frames of worlds never seen."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from stereoweave.bench.projected_views import DisparityMethod, ProjectionRow, score_projections
from stereoweave.data.frames import Frame
from stereoweave.data.poses import Pose, find_nearest_frames, read_poses
from stereoweave.errors import StereoweaveError
from stereoweave.learn.data.sources import DatasetFrames, divide_frames, spread_evenly
from stereoweave.learn.evaluation import MEDIAN, identify_held_out, load_runs, make_median_method, make_method
from stereoweave.learn.recipe import Recipe

NEAREST = "nearest frame"
TRAINING = "training"
# The dataset whose frames have poses.
WORLDS = "paper_worlds"


@dataclass(frozen=True, kw_only=True)
class WorldsRow:
    """Mean scores of one method on frames of one part of a set.

    Attributes:
        split: "training", frames that the networks were trained on; the recipe's split, whose held-out frames
            are of the same worlds; or the split that it leaves out, whose frames are of other worlds.
        method: Name of a run; a baseline of `score_projections`; "median", the training pairs' median
            disparity; or "nearest frame", the true depth of the training frame whose camera is nearest.
        pairs: Number of scored pairs.
        steps: Training steps of a run; 0 for all other methods.
        nearest_m: Mean distance between the left cameras of a scored pair and of its nearest training frame,
            which is the pair itself in training.
        epe_cm, epe_px, mae_sourced, sourced_percent, mae_filled, psnr_db, ssim: See `ProjectionRow`.
        epe_cm_sd: Standard deviation of `epe_cm` over the pairs.
    """

    split: str
    method: str
    pairs: int
    steps: int
    nearest_m: float
    epe_cm: float
    epe_cm_sd: float
    epe_px: float
    mae_sourced: float
    sourced_percent: float
    mae_filled: float
    psnr_db: float
    ssim: float


def score_worlds(recipe: Recipe, runs: Sequence[Path], most: int | None = None) -> Iterator[WorldsRow]:
    """Score runs, and methods without training, on training frames, held-out frames and left-out worlds.

    There are as many training frames as held-out ones, evenly spread.

    Args:
        recipe: Recipe of a set by world, with a split that it leaves out.
        runs: Run folders of `stereoweave train`, or checkpoints, all with the recipe's held-out pairs.
        most: Greatest number of frames to score per split, evenly spread; None for all.

    Raises:
        StereoweaveError: The recipe leaves out no split of a set by world; a run has other pairs; two rows
            would have the same name; or the set is incomplete.
    """
    _check_recipe(recipe)
    kept = load_runs(runs, (MEDIAN, NEAREST))
    for name, one in kept.items():
        _check_pairs(name, one.recipe, recipe)
    training, held_out, left_out = divide_frames(recipe)
    methods = {MEDIAN: make_median_method(DatasetFrames(training))}
    methods |= {name: make_method(one) for name, one in kept.items()}
    scorer = WorldScorer(recipe.max_depth_m, training, read_poses(Path(recipe.root)), methods)
    seen = spread_evenly(training, len(held_out))
    for split, frames in ((TRAINING, seen), (recipe.split, held_out), (recipe.leave_out, left_out)):
        for row in scorer.score(spread_evenly(frames, most)):
            found = kept.get(row["method"])
            yield WorldsRow(split=split, steps=found.step if found else 0, **row)


@dataclass(frozen=True)
class WorldScorer:
    """Scorer of methods, among them the nearest of the training frames, on other frames of the same set.

    Attributes:
        max_depth_m: Depth of training frames where it is unknown, and maximum of estimated depths.
        training: Frames among which the nearest one is searched.
        poses: Poses of all frames, by name.
        methods: Further methods, by name.
    """

    max_depth_m: float
    training: Sequence[Frame]
    poses: Mapping[str, Pose]
    methods: Mapping[str, DisparityMethod]

    def score(self, frames: Sequence[Frame]) -> Iterator[dict[str, Any]]:
        """Yield the columns of `WorldsRow`, except split and steps, for each method."""
        by_name = {frame.name: frame for frame in self.training}
        nearest = find_nearest_frames([frame.name for frame in frames], list(by_name), self.poses)
        rows = [self._score_frame(frame, by_name[nearest[frame.name]]) for frame in frames]
        pairs = (
            (self.poses[name].position_m, self.poses[other].position_m) for name, other in nearest.items()
        )
        nearest_m = float(np.mean([np.linalg.norm(one - other) for one, other in pairs]))
        for of_method in zip(*rows, strict=True):
            yield {
                **_average(of_method),
                "pairs": len(frames),
                "nearest_m": nearest_m,
                "epe_cm_sd": float(np.std([row.epe_cm for row in of_method])),
            }

    def _score_frame(self, frame: Frame, nearest: Frame) -> list[ProjectionRow]:
        sample, nearest_px = frame.read(), self._read_truth_px(nearest)
        methods = {NEAREST: lambda _: nearest_px, **self.methods}
        return score_projections(methods, [sample], self.max_depth_m)

    def _read_truth_px(self, frame: Frame) -> Float[np.ndarray, "h w"]:
        """Return the true disparity of a frame; where it is unknown, that of the greatest depth."""
        sample = frame.read()
        if sample.camera is None:
            raise StereoweaveError(f"{frame.name}: expected a camera, found none")
        farthest_px = sample.camera.disparity_px(np.full_like(sample.disparity_px, self.max_depth_m))
        return np.where(np.isfinite(sample.disparity_px), sample.disparity_px, farthest_px)


def _check_recipe(recipe: Recipe) -> None:
    if recipe.dataset != WORLDS or not recipe.leave_out:
        raise StereoweaveError(
            f"{recipe.name}: expected dataset = {WORLDS!r} and a split in leave_out, found dataset = "
            f"{recipe.dataset!r} and leave_out = {recipe.leave_out!r}; "
            "see recipes/paper/propeller_worlds.toml"
        )


def _check_pairs(name: str, trained: Recipe, recipe: Recipe) -> None:
    if identify_held_out(trained) != identify_held_out(recipe):
        raise StereoweaveError(
            f"{name}: expected a run with the held-out pairs of {recipe.name}, {identify_held_out(recipe)}, "
            f"found {identify_held_out(trained)}; score it with its own recipe"
        )


def _average(rows: Iterable[ProjectionRow]) -> dict[str, Any]:
    """Return the mean of each number, and the method that the rows have in common."""
    columns = [asdict(row) for row in rows]
    return {
        name: value if name == "method" else float(np.mean([column[name] for column in columns]))
        for name, value in columns[0].items()
    }
