from dataclasses import replace

import torch
from learn_examples import RECIPE

from experiments.average_weights.averaging import average_and_score
from stereoweave.learn import checkpoint
from stereoweave.learn.data.sources import open_sources
from stereoweave.learn.training.scores import validate


def test_the_mean_is_scored_as_it_is_written(tmp_path):
    recipe = replace(RECIPE, dataset="collage", validation_pairs=1, pair_size=(64, 96))
    start = checkpoint.make_initial(recipe, "0123abc")
    files = []
    for factor in (0.9, 1.1):
        weights = {
            name: value * factor if value.is_floating_point() else value
            for name, value in start.averaged.items()
        }
        files.append(tmp_path / f"{factor}.pt")
        checkpoint.save(replace(start, averaged=weights, origin=start.as_origin()), files[-1])
    mean = average_and_score(files, tmp_path / "pairs")
    for name, value in start.averaged.items():
        torch.testing.assert_close(mean.averaged[name].to(value.dtype), value, rtol=1e-3, atol=1e-7)
    _, held_out = open_sources(recipe, tmp_path / "pairs")
    assert mean.scores == validate(mean.build_averaged(), held_out, torch.device("cpu"))
