"""Trainings of the paper's network on seven scenes, from a trained network and from random weights."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from experiments.paper_sets.sets import PaperSet, read_sets
from experiments.trial import Trial
from stereoweave.errors import StereoweaveError
from stereoweave.learn.recipe import Recipe
from stereoweave.synth.sets.make import make

# The scene that the start was trained on.
SOURCE = "propeller"
SCRATCH, TUNED = "from random weights", f"from the {SOURCE}"


def list_sets() -> list[PaperSet]:
    """Return the paper's sets, except the one that the start was trained on."""
    return [one for one in read_sets() if one.scene != SOURCE]


def render_first_frames(
    one: PaperSet, frames: int, size_px: tuple[int, int], folder: Path, jobs: int
) -> None:
    """Render the first `frames` frames of each world of a set into a folder, or what is missing of them."""
    spec = replace(one.spec(size_px), frames=frames)
    make(spec, one.worlds * frames, folder, layout="paper", jobs=jobs)


def list_trials(base: Recipe, scenes: Sequence[str], worlds: Path, start: Path, seeds: int) -> list[Trial]:
    """List the trainings: for each scene and seed, one from the checkpoint `start` and one without it.

    Raises:
        StereoweaveError: The checkpoint is missing.
    """
    if not start.is_file():
        raise StereoweaveError(f"{start}: expected a checkpoint of stereoweave train, found none")
    # Absolute, so that a resumed experiment may spell the path differently.
    origins = {SCRATCH: "", TUNED: str(start.resolve())}
    return [
        Trial(
            claim=scene,
            setting=setting,
            recipe=replace(
                base,
                name=f"{scene}-{'tuned' if origin else 'scratch'}-seed{seed}",
                root=str((worlds / scene).resolve()),
                seed=seed,
                start_from=origin,
            ),
        )
        for scene in scenes
        for setting, origin in origins.items()
        for seed in range(base.seed, base.seed + seeds)
    ]
