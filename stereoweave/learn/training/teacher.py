"""A trained WeaveNet that teaches a smaller one: its results are targets beside the ground truth.

Its distribution over the levels says which other levels are plausible, which the ground truth does not
(Hinton et al., Distilling the Knowledge in a Neural Network, 2015).
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from stereoweave.errors import FormatError
from stereoweave.learn import checkpoint
from stereoweave.learn.models.weave import WeaveNet, WeaveStages


class Lesson(NamedTuple):
    """The teacher's results for both views; the second half of the batch is mirrored.

    Attributes:
        probabilities: Probability of each level [2B, D, H/4, W/4].
        disparity_px: Disparity [2B, 1, H, W].
    """

    probabilities: Float[Tensor, "b d h_d w_d"]
    disparity_px: Float[Tensor, "b 1 h w"]


class Teacher:
    """The averaged network of a checkpoint, in inference mode.

    Args:
        path: Checkpoint of a WeaveNet.

    Raises:
        FormatError: The checkpoint holds another network.
    """

    def __init__(self, path: Path) -> None:
        kept = checkpoint.load(path)
        with torch.device("cpu"):  # recipes are checked on the device "meta"
            network = kept.build_averaged()
        if not isinstance(network, WeaveNet):
            raise FormatError(f"{path}: expected a WeaveNet as teacher, found {kept.recipe.model}")
        self.network = network.requires_grad_(False)

    def teach(self, left: Float[Tensor, "b 3 h w"], right: Float[Tensor, "b 3 h w"]) -> Lesson:
        """Return the teacher's results for a batch."""
        stages = self.network.to(left.device).stages(left, right)
        return Lesson(stages.scores.float().softmax(1), stages.disparity_px)


def distillation_losses(
    stages: WeaveStages, lesson: Lesson, compare: Callable[[Tensor, Tensor], Tensor]
) -> dict[str, Tensor]:
    """Return the terms that draw a prediction to the teacher's, by name.

    They are the cross-entropy between the distributions over the levels, and the loss `compare` between the
    disparities in px. Both count every pixel, also where the ground truth is unknown.
    """
    log_probabilities = F.log_softmax(stages.scores.float(), 1)
    return {
        "taught_scores": -(lesson.probabilities * log_probabilities).sum(1).mean(),
        "taught_disparity": compare(stages.disparity_px, lesson.disparity_px),
    }
