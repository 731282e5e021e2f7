"""Division of a dataset into training and held-out frames, according to the rules in split_rules/."""

import tomllib
from fnmatch import fnmatchcase
from importlib.resources import files
from itertools import groupby
from typing import Any

import numpy as np

from stereoweave.arguments import check_choice, suggest
from stereoweave.data.frames import Frame
from stereoweave.errors import StereoweaveError

SPLITS = ("random", "disjoint")


def split_frames(frames: list[Frame], dataset: str, split: str) -> tuple[list[Frame], list[Frame]]:
    """Split frames into training frames and held-out frames, each sorted by name.

    Args:
        frames: Frames of one dataset, in any order.
        dataset: Name of the dataset in `DATASETS`.
        split: "random", as in the paper, or "disjoint", which holds out whole sequences or their ends.

    Raises:
        StereoweaveError: The dataset or split is unknown, or one part is empty.
    """
    ordered = sorted(frames, key=lambda frame: frame.name)
    held_out = _choose_held_out(_read_rule(dataset, split), ordered)
    training = [frame for frame in ordered if frame.name not in held_out]
    if not (training and held_out):
        raise StereoweaveError(
            f"split {split!r} of {dataset}: expected frames to train on and frames to hold out, "
            f"found {len(training)} and {len(held_out)}; is the dataset complete?"
        )
    return training, [frame for frame in ordered if frame.name in held_out]


def _read_rule(dataset: str, split: str) -> dict[str, Any]:
    check_choice("split", split, SPLITS)
    rules = tomllib.loads((files(__package__) / "split_rules" / f"{split}.toml").read_text(encoding="utf-8"))
    if dataset not in rules:
        raise StereoweaveError(
            f"dataset to split: expected one of {', '.join(rules)}, found {dataset!r}"
            + suggest(dataset, list(rules))
        )
    return rules[dataset]


def _choose_held_out(rule: dict[str, Any], frames: list[Frame]) -> set[str]:
    names = [frame.name for frame in frames]
    match rule:
        case {"random_share": share, "seed": seed}:
            order = np.random.default_rng(seed).permutation(len(names))
            return {names[i] for i in order[: _count(share, len(names))]}
        case {"last_share": share}:
            sequences = (list(group) for _, group in groupby(frames, key=lambda frame: frame.sequence))
            return {frame.name for run in sequences for frame in run[-_count(share, len(run)) :]}
        case {"last_sequences": share}:
            last = _choose_last(share, frames)
            return {frame.name for frame in frames if frame.sequence in last}
        case {"names": patterns}:
            return {name for name in names if any(fnmatchcase(name, pattern) for pattern in patterns)}
    raise AssertionError(rule)


def _choose_last(share: float, frames: list[Frame]) -> set[str]:
    """Return the last sequences of every folder."""
    sequences = sorted({frame.sequence for frame in frames})
    folders = (list(group) for _, group in groupby(sequences, key=lambda name: name.rpartition("/")[0]))
    return {name for folder in folders for name in folder[-_count(share, len(folder)) :]}


def _count(share: float, frames: int) -> int:
    return max(1, round(share * frames))
