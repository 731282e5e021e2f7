"""Average checkpoints, and score the mean."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from rich.console import Console

from stereoweave.learn import checkpoint
from stereoweave.learn.data.sources import cache_pairs, open_sources
from stereoweave.learn.training.scores import validate


def average_and_score(checkpoints: Sequence[Path], pairs: Path) -> checkpoint.Checkpoint:
    """Return the mean of checkpoints in 16 bits, with its scores on the held-out pairs of the first recipe.

    Args:
        checkpoints: Files of checkpoints that descend from the same run.
        pairs: Folder for the held-out collages.

    Raises:
        FormatError: As for `checkpoint.load` and `checkpoint.average`.
    """
    mean = checkpoint.strip_to_average(checkpoint.average([checkpoint.load(file) for file in checkpoints]))
    _, held_out = open_sources(replace(mean.recipe, mix=()), pairs)
    scores = validate(mean.build_averaged(), cache_pairs(held_out, Console(stderr=True)), torch.device("cpu"))
    return replace(mean, scores=scores)
