"""Shared by the tests of training: a pair with exact ground truth, and a network trained on it."""

import functools
import json
from dataclasses import asdict, dataclass, replace

import numpy as np
import pytest
import torch

from stereoweave.data.packing import pack
from stereoweave.data.shards import write_shard
from stereoweave.errors import StereoweaveError
from stereoweave.learn.checkpoint import Checkpoint
from stereoweave.learn.data.batches import collate
from stereoweave.learn.data.pair_cache import CachedPairs
from stereoweave.learn.models import build_network
from stereoweave.learn.models.weave import WeaveNet
from stereoweave.learn.recipe import Recipe
from stereoweave.learn.training.losses import weave_losses
from stereoweave.stereo import Sample, StereoCamera

# For images this small, sharing the work among threads costs more than computing.
torch.set_num_threads(1)

PAIR_SIZE = (64, 96)
RECIPE = Recipe(
    name="tiny",
    model="weave_small",
    steps=20,
    batch=2,
    learning_rate=1e-3,
    warm_up_steps=2,
    cool_down_steps=2,
    pairs=4,
    pair_size=PAIR_SIZE,
    crop_size=(64, 64),
    validation_pairs=2,
    validate_every=2,
)
# GA-Net pads to multiples of 48, and its recursions take seconds for larger volumes.
_SMALL_GANET = {"crop_size": (48, 48), "max_disparity_px": 24.0}
SMALLER = {"ganet_11": _SMALL_GANET, "ganet_deep": _SMALL_GANET}
# f B = 24 px m: the box of `box_before_a_wall` is at 2 m, its wall at 6 m.
CAMERA = StereoCamera(focal_px=120.0, baseline_m=0.2, cx_px=47.5, cy_px=31.5)


def recipe_of(model, **changes):
    """Return RECIPE with another model and its loss; PSMNet gets only 48 candidates.

    With 32 candidates a volume would be 2 levels deep, for which oneDNN's bfloat16 gradient is wrong.
    """
    loss = {"weave": "weave", "mc": "hinge"}.get(model.split("_")[0], "l2")
    fitting = {"model": model, "loss": loss, "max_disparity_px": 48.0, **SMALLER.get(model, {})}
    return replace(RECIPE, **fitting | changes)


def texture(rng, height, width):
    blocks = rng.integers(30, 226, (height // 4 + 1, width // 4 + 1, 3)).repeat(4, 0).repeat(4, 1)
    return (blocks[:height, :width] + rng.integers(-30, 30, (height, width, 3))).astype(np.uint8)


def box_before_a_wall(rng, size=PAIR_SIZE, wall_px=4, box_px=12):
    """Return a sample of two flat surfaces; the box covers the middle half of the left rows and columns."""
    height, width = size
    wall, box = texture(rng, height, width + wall_px), texture(rng, height // 2, width // 2)
    rows, start = slice(height // 4, height // 4 + height // 2), width // 4
    in_left, in_right = np.zeros((2, height, width), bool)
    in_left[rows, start : start + width // 2] = True
    in_right[rows, start - box_px : start - box_px + width // 2] = True
    left, right = wall[:, :width].copy(), wall[:, wall_px:].copy()
    left[in_left], right[in_right] = box.reshape(-1, 3), box.reshape(-1, 3)
    # The wall's column x in the left view is column x - wall_px in the right view.
    occluded, right_occluded = np.ones((2, height, width), bool)
    occluded[:, wall_px:] = in_right[:, :-wall_px]
    right_occluded[:, :-wall_px] = in_left[:, wall_px:]
    return Sample(
        left=left,
        right=right,
        disparity_px=np.where(in_left, box_px, wall_px).astype(np.float32),
        right_disparity_px=np.where(in_right, box_px, wall_px).astype(np.float32),
        occluded=occluded & ~in_left,
        right_occluded=right_occluded & ~in_right,
    )


def keep_pairs(folder, seed, count, size=PAIR_SIZE):
    """Fill the pair cache of a training with pairs of this file instead of collages."""
    pairs = CachedPairs(folder, seed, count, size)
    pairs.folder.mkdir(parents=True, exist_ok=True)
    for index in range(count):
        pairs.keep(index, box_before_a_wall(np.random.default_rng((seed, index)), size))
    return pairs


def make_batches_in_place(patch):
    """Make batches in the training process itself, because another process takes seconds to load PyTorch."""
    patch.setattr(
        "stereoweave.learn.training.loop._load_batches",
        lambda batches, first: ((step, batches[step]) for step in range(first, batches.recipe.steps)),
    )


def untrained(name="weave_small"):
    torch.manual_seed(0)
    return build_network(recipe_of(name)).eval()


def random_pair(batch, height, width):
    """Return the same noise at every call, as the left and right images of a batch."""
    torch.manual_seed(1)
    return torch.rand(batch, 3, height, width), torch.rand(batch, 3, height, width)


def checkpoint_of(network, recipe=RECIPE):
    weights = network.state_dict()
    return Checkpoint(
        recipe=recipe,
        step=recipe.steps,
        weights=weights,
        averaged=weights,
        optimiser={},
        random_state=torch.get_rng_state(),
        scores={"epe_px": 1.5},
        commit="0123abc",
        hours=0.25,
    )


def complaint(call, *arguments) -> str:
    """Return the one-line error that the call must raise."""
    with pytest.raises(StereoweaveError) as caught:
        call(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def write_box_set(folder):
    """Write a rendered set of one pair, a box before a wall. Returns its folder."""
    folder.mkdir()
    sample = replace(box_before_a_wall(np.random.default_rng(0)), camera=CAMERA)
    write_shard(folder, "boxes", 0, [pack(sample, {})])
    return folder


@dataclass(frozen=True)
class Listed:
    """Source of samples in memory."""

    samples: list[Sample]

    @property
    def count(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> Sample:
        return self.samples[index]

    def name(self, index: int) -> str:
        return f"sample {index}"


@dataclass(frozen=True)
class Overfitted:
    network: WeaveNet
    sample: Sample
    error_before_px: float
    error_after_px: float


@functools.cache
def overfitted(name="weave_small", steps=45) -> Overfitted:
    """Overfit a network to one pair; also return its mean error on the pair before and after training."""
    network, sample = untrained(name), box_before_a_wall(np.random.default_rng(0))
    batch = collate([sample])
    before_px = mean_error_px(network, batch)
    optimiser = torch.optim.AdamW(network.parameters(), 2e-3)
    network.train()
    for _ in range(steps):
        stages = network.stages(batch["left"], batch["right"])
        loss = torch.stack(
            list(weave_losses(stages, batch["disparity_px"], batch["occluded"]).values())
        ).sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    network.eval()
    return Overfitted(network, sample, before_px, mean_error_px(network, batch))


@torch.no_grad()
def mean_error_px(network, batch) -> float:
    found_px = network.stages(batch["left"], batch["right"]).disparity_px
    return float((found_px - batch["disparity_px"]).abs().mean())


def list_maps(stages) -> list[torch.Tensor]:
    """List the maps of a WeaveNet's results."""
    *maps, logits = vars(stages).values()
    return [*maps, *logits]


def write(recipe, file):
    """Write the recipe to the file and return the file's path."""
    lines = (f"{name} = {json.dumps(value)}" for name, value in asdict(recipe).items())
    file.write_text("\n".join(lines) + "\n")
    return file


def assert_same(one, other):
    """Assert that two values are bitwise equal, recursively through dictionaries and lists."""
    if isinstance(one, torch.Tensor):
        assert torch.equal(one, other)
    elif isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_same(one[key], other[key])
    else:
        assert one == other
