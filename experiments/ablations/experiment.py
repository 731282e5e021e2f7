"""Ablations: WeaveNet with one design choice changed at a time, at an equal training budget."""

import csv
import os
import platform
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console

from experiments.ablations.networks import register_variants
from experiments.trial import Trial, fingerprint
from stereoweave.bench.edge_metrics import edge_bad_percent, edge_epe_px, flying_percent
from stereoweave.bench.projected_views import DisparityMethod
from stereoweave.data.shards import Shards
from stereoweave.errors import StereoweaveError
from stereoweave.io.files import make_folder, replacing
from stereoweave.learn import checkpoint
from stereoweave.learn.checkpoint import Checkpoint
from stereoweave.learn.data.sources import PairSource, RenderedSet, cache_pairs, open_sources
from stereoweave.learn.evaluation import make_method
from stereoweave.learn.export.from_checkpoint import count_multiply_adds
from stereoweave.learn.recipe import COLLAGE, Recipe
from stereoweave.learn.training.loop import train_recipe
from stereoweave.learn.training.scores import validate

BASE = "base"
MIX = ((COLLAGE, 0.55), ("runs/synth/rooms", 0.33), ("runs/synth/scenes", 0.12))
# For each design choice, its variations and their changes to the base recipe.
VARIATIONS: dict[str, dict[str, dict[str, Any]]] = {
    "what all are compared with": {BASE: {}},
    "correlation resolution": {"eighth": {"model": "weave_small_eighth"}},
    "correlation grouping": {"four_groups": {"model": "weave_small_grouped"}},
    "distribution loss against regression": {
        "regression": {"distribution": 0.0},
        "regression_all_levels": {"distribution": 0.0, "model": "weave_small_all_levels"},
    },
    "sharpening at edges": {"all_levels": {"model": "weave_small_all_levels"}},
    "dilated dense blocks": {
        "undilated": {"model": "weave_small_undilated"},
        "without_dense": {"model": "weave_small_without_dense"},
    },
    "context at 1/16": {"without_context": {"model": "weave_small_without_context"}},
    "upsampling": {
        "bilinear": {"model": "weave_small_bilinear"},
        "nine_neighbours": {"model": "weave_small_nine_neighbours"},
    },
    "comparison at 1/2": {"looked_up": {"model": "weave_small_looked_up"}},
    "exponent p on the normalised disparity": {"exponent_1.5": {"exponent": 1.5}},
    "projection loss": {"projection": {"alpha_p": 100.0}},
    "both of the paper's": {"projection_exponent_1.5": {"alpha_p": 100.0, "exponent": 1.5}},
    "mix of data": {"mix": {"mix": MIX}},
}

_CPU = torch.device("cpu")


def plan(base: Recipe, seeds: int, only: Sequence[str] = ()) -> list[Trial]:
    """Return trials of all variations with the first seed, then with each further seed.

    Args:
        base: Recipe that every variation changes.
        seeds: Number of seeds.
        only: Names of the only variations to train beside the base; all if empty.

    Raises:
        StereoweaveError: If `only` has an unknown name.
    """
    names = [name for variations in VARIATIONS.values() for name in variations]
    if unknown := [name for name in only if name not in names]:
        raise StereoweaveError(f"only: expected some of {', '.join(names)}, found {unknown[0]!r}")
    return [
        Trial(
            claim=choice,
            setting=name,
            recipe=replace(base, seed=seed, name=f"{name}-seed{seed}", **changes),
        )
        for seed in range(base.seed, base.seed + seeds)
        for choice, variations in VARIATIONS.items()
        for name, changes in variations.items()
        if not only or name in (BASE, *only)
    ]


def run_ablations(
    planned: Sequence[Trial], runs: Path, rendered: Path, report: Path, console: Console
) -> None:
    """Train each variation in its own folder, and rewrite the report after each training run.

    Rows of the report with the same recipe are reused; other rows are dropped.

    Args:
        planned: Trials to train.
        runs: Folder of the runs, with cached pairs in the subfolder `pairs`.
        rendered: Set of held-out rendered pairs, scored in addition to the held-out collages.
        report: CSV file to write.
        console: Console that shows the progress.

    Raises:
        StereoweaveError: If training or held-out pairs are missing; raised before training starts.
    """
    register_variants()
    rendered_pairs = RenderedSet(Shards(rendered))
    for trial in planned:
        for pairs in open_sources(trial.recipe, runs / "pairs"):
            cache_pairs(pairs, console)
    before = {row.get("fingerprint"): row for row in _read_report(report)}
    rows = {i: row for i, trial in enumerate(planned) if (row := before.get(fingerprint(trial.recipe)))}
    for i, trial in enumerate(planned):
        if i in rows:
            continue
        trained = checkpoint.load(train_recipe(trial.recipe, runs / trial.recipe.name, console))
        _, collages = open_sources(trial.recipe, runs / "pairs")
        held_out = {"collage": collages, "rendered": rendered_pairs}
        rows[i] = {key: _format_value(value) for key, value in _make_row(trial, trained, held_out).items()}
        _write_report(report, [rows[j] for j in sorted(rows)])
        console.print(f"{trial.recipe.name}: {len(rows)} of {len(planned)}")


def _make_row(trial: Trial, trained: Checkpoint, held_out: dict[str, PairSource]) -> dict[str, object]:
    network = trained.build_averaged()
    changes = VARIATIONS[trial.claim][trial.setting]
    scores = {
        f"{pairs}_{name}": value
        for pairs, source in held_out.items()
        for name, value in (
            validate(network, source, _CPU) | _measure_near_edges(make_method(trained), source)
        ).items()
    }
    return {
        "choice": trial.claim,
        "variation": trial.setting,
        "seed": trained.recipe.seed,
        "changes": ", ".join(f"{key} = {value}" for key, value in changes.items()),
        "fingerprint": fingerprint(trial.recipe),
        "commit": trained.commit,
        "machine": f"{platform.machine()} {torch.backends.cpu.get_cpu_capability()}, {os.cpu_count()} cores",
        "steps": trained.step,
        "pairs_seen": trained.step * trained.recipe.batch,
        "hours": trained.hours,
        "parameters": sum(parameter.numel() for parameter in network.parameters()),
        "multiply_adds": count_multiply_adds(network),
        **scores,
    }


def _measure_near_edges(match: DisparityMethod, pairs: PairSource) -> dict[str, float]:
    """Return mean errors near depth edges, over the pairs that have edges."""
    rows = []
    for index in range(pairs.count):
        sample = pairs[index]
        found_px, truth_px = match(sample), sample.disparity_px
        rows.append(
            {
                "edge_epe_px": edge_epe_px(found_px, truth_px),
                "edge_bad1_percent": edge_bad_percent(found_px, truth_px, 1),
                "flying_percent": flying_percent(found_px, truth_px),
            }
        )
    return {name: float(np.nanmean([row[name] for row in rows])) for name in rows[0]}


def _format_value(value: object) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def _read_report(report: Path) -> list[dict[str, str]]:
    if not report.exists():
        return []
    with report.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _write_report(report: Path, rows: Sequence[dict[str, str]]) -> None:
    make_folder(report.parent)
    with replacing(report) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[-1]))
        writer.writeheader()
        writer.writerows(rows)
