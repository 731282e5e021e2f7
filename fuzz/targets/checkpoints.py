"""Training checkpoints, and files with the weights of MC-CNN."""

from functools import partial
from pathlib import Path

import torch

from fuzz.targets import Target, read_every_way, write_to_bytes
from stereoweave.learn.checkpoint import Checkpoint, load, save
from stereoweave.learn.models.mc_cnn import load_weights
from stereoweave.learn.recipe import parse_recipe

_RECIPE = {
    **{"name": "x", "model": "weave_small", "steps": 10, "batch": 4, "learning_rate": 1e-3},
    **{"warm_up_steps": 4, "cool_down_steps": 2, "mix": {"collage": 1.0}},
}


def _starts() -> dict[str, bytes]:
    weights = {"layer.weight": torch.ones(2, 3), "layer.bias": torch.zeros(2, dtype=torch.float16)}
    checkpoint = Checkpoint(
        recipe=parse_recipe(_RECIPE, "a recipe"),
        step=3,
        weights=weights,
        averaged=weights,
        optimiser={"state": {0: {"step": torch.tensor(3.0)}}, "param_groups": [{"lr": 1e-3}]},
        random_state=torch.zeros(4, dtype=torch.uint8),
        scores={"epe_px": 1.5},
        commit="0123456",
        hours=0.5,
    )
    return {"last.pt": write_to_bytes("last.pt", partial(save, checkpoint))}


def _read(path: Path) -> None:
    read_every_way(partial(load, path), partial(load_weights, path))


TARGET = Target(
    starts=_starts,
    read=_read,
    tokens=(
        *b"PK\x03\x04 PK\x01\x02 PK\x05\x06 data.pkl \x80\x02 }q\0 R b. K\x01 recipe mix steps".split(),
        *(b"cos\nsystem\n", b"ctorch._utils\n_rebuild_tensor_v2\n", b"byteorder", b"FloatStorage"),
    ),
)
