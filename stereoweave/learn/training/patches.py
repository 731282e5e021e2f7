"""MC-CNN's objective: a hinge loss on pairs of patches (section 3.1 of its paper; section 5.1 for the pairs).

Deviations: patches are drawn from crops, whose levels are standardised crop by crop; they are neither rotated
nor sheared, because `data/augment.py` has changed the crops already; the optimiser is the project's.
"""

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from stereoweave.bench import metrics
from stereoweave.bench.mc_cnn.steps import find_nearest_vectors
from stereoweave.learn.data.batches import read_known
from stereoweave.learn.data.sources import PairSource
from stereoweave.learn.mc_cnn_matcher import describe
from stereoweave.learn.models.mc_cnn import MCCNN, PATCH_PX, standardise
from stereoweave.learn.recipe import Recipe

Similarities = tuple[Float[Tensor, " n"], Float[Tensor, " n"]]

MARGIN = 0.2
"""By this much a true match must be more similar than a false one, or it costs something."""
POSITIVE_PX, NEGATIVE_PX = 0.5, (1.5, 6.0)
"""Greatest offset of a true match, and the least and greatest of a false one (the paper's for Middlebury)."""
PATCHES = 32
"""Number of patches drawn from each crop; the paper's batch has 64 in all."""


class PatchObjective:
    """Objective of MC-CNN: true matches are more similar than false ones on the same row."""

    recordable = False  # the number of patches depends on the batch

    def __init__(self, recipe: Recipe) -> None:
        self.recipe = recipe

    def check(self, batch: dict[str, Tensor]) -> None:
        """Accept every batch: patches are drawn where the truth is known."""

    def predict(self, network: MCCNN, batch: dict[str, Tensor]) -> Similarities:
        """Return the similarities of left patches to a true and to a false match each."""
        count = len(batch["left"])
        truth_px = batch["disparity_px"][:count, 0]
        seen = truth_px.isfinite() & ~batch["occluded"][:count, 0]
        left, right = standardise(batch["left"])[:, None], standardise(batch["right"])[:, None]
        drawn = [_draw(left[i], right[i], truth_px[i], seen[i]) for i in range(count)]
        kinds = (torch.cat(patches) for patches in zip(*drawn, strict=True))
        own, true, false = (network.describe_patches(patches) for patches in kinds)
        return (own * true).sum(1), (own * false).sum(1)

    def losses(self, predicted: Similarities, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the mean of the hinge loss over all patches."""
        true, false = predicted
        return {"hinge": hinge_loss(true, false)}

    def scores(self, network: Any, pairs: PairSource, device: torch.device) -> dict[str, float]:
        """Return mean errors of the disparities whose vectors are most similar, without further steps."""
        network.eval()
        rows = [self._score(network, pairs, index) for index in range(pairs.count)]
        return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}

    def _score(self, network: MCCNN, pairs: PairSource, index: int) -> dict[str, float]:
        sample = read_known(pairs, index)
        left, right = (describe(network, view) for view in (sample.left, sample.right))
        found_px = find_nearest_vectors(left, right, int(self.recipe.max_disparity_px))
        return {
            "epe_px": metrics.epe_px(found_px, sample.disparity_px),
            "bad1_percent": metrics.bad_percent(found_px, sample.disparity_px, 1),
            "bad2_percent": metrics.bad_percent(found_px, sample.disparity_px, 2),
        }


def hinge_loss(true: Float[Tensor, " n"], false: Float[Tensor, " n"]) -> Tensor:
    """Return the mean of max(0, MARGIN + false - true) over pairs of similarities; 0 if there are none."""
    return (MARGIN + false - true).clamp(min=0).sum() / max(len(true), 1)


def cut_patches(
    view: Float[Tensor, "1 1 h w"], x: Float[Tensor, " n"], y: Float[Tensor, " n"]
) -> Float[Tensor, "n 1 s s"]:
    """Return the 11x11 patches around the places (x, y), interpolated between pixels."""
    height, width = view.shape[2:]
    offsets = torch.arange(PATCH_PX, device=view.device) - PATCH_PX // 2
    columns = (x[:, None, None] + offsets).expand(-1, PATCH_PX, -1)
    rows = (y[:, None, None] + offsets[:, None]).expand(-1, -1, PATCH_PX)
    grid = torch.stack([(2 * columns + 1) / width - 1, (2 * rows + 1) / height - 1], -1)
    found = F.grid_sample(view, grid.flatten(0, 1)[None].float(), align_corners=False)
    return found.reshape(-1, 1, PATCH_PX, PATCH_PX)


def _draw(
    left: Float[Tensor, "1 1 h w"],
    right: Float[Tensor, "1 1 h w"],
    truth_px: Float[Tensor, "h w"],
    seen: Bool[Tensor, "h w"],
) -> tuple[Tensor, Tensor, Tensor]:
    """Return random patches of a pair [N, 1, 11, 11]: left ones, true matches and false ones.

    None of them reaches over a border. N is PATCHES; 0 if the pair has no place for them.
    """
    height, width = truth_px.shape
    edge, reach = PATCH_PX // 2, PATCH_PX // 2 + int(np.ceil(NEGATIVE_PX[1]))
    matches = torch.arange(width, device=truth_px.device) - truth_px
    seen = seen & (matches >= reach) & (matches <= width - 1 - reach)
    seen[:edge], seen[height - edge :], seen[:, :edge], seen[:, width - edge :] = (False,) * 4
    places = seen.nonzero()
    # Drawn on the CPU, so that every device draws the same patches.
    chosen = places[torch.randint(len(places), (PATCHES,)).to(places.device)] if len(places) else places
    y, x = chosen.unbind(1)
    near = (2 * torch.rand(len(y)) - 1) * POSITIVE_PX
    far = torch.empty(len(y)).uniform_(*NEGATIVE_PX) * (2 * torch.randint(2, (len(y),)) - 1)
    match = matches[y, x]
    return (
        cut_patches(left, x.float(), y.float()),
        cut_patches(right, match + near.to(match.device), y.float()),
        cut_patches(right, match + far.to(match.device), y.float()),
    )
