"""Training recipes."""

from pathlib import Path

from fuzz.targets import Target
from stereoweave.learn.recipe import read_recipe

_SMALLEST = b"""name = "x"
model = "weave_small"
steps = 10
batch = 4
learning_rate = 1e-3
warm_up_steps = 4
cool_down_steps = 2
crop_size = [64, 96]
[mix]
collage = 0.5
"runs/synth/rooms" = 2
[held_out]
rooms = "held_out/rooms"
"""
_PAPER = b"""name = "y"
model = "fast_depth"
dataset = "sintel"
root = "datasets/sintel"
steps = 10
batch = 4
micro_batch = 2
learning_rate = 1
warm_up_steps = 4
cool_down_steps = 2
loss = "l2"
target = "depth"
exponent = 1.5
augment = false
"""


def _read(path: Path) -> None:
    recipe = read_recipe(path)
    hash(recipe)
    for step in (0, recipe.steps // 2, recipe.steps):
        recipe.learning_rate_at(step)
    assert recipe.micro_batches > 0


TARGET = Target(
    starts=lambda: {"smallest.toml": _SMALLEST, "paper.toml": _PAPER},
    read=_read,
    tokens=(
        *rb'[ ] [[ ]] { } a. inf nan true " """ '.split(),
        *rb"' ''' \u \UFFFFFFFF 1979-05-27T07:32:00Z 0x 0b1 1_0 #".split(),
        *(
            b"\na = " + b"[" * 20_000,
            b"\na" + b".a" * 20_000,
            b"= [",
            b"= {a = ",
            b"\n",
            b"\r",
            b"\0",
            b"seed = ",
            b"mix = ",
            b"pair_size = ",
            b"[mix.a]\n",
        ),
    ),
)
