"""Description of one training run of an experiment, and the hash of its recipe."""

import hashlib
from dataclasses import dataclass, fields
from pathlib import Path

from stereoweave.learn.recipe import Recipe


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One training run of an experiment.

    Attributes:
        claim: Claim or design choice that the run tests.
        setting: Name of the tested setting; runs that differ only in their seeds share it.
        recipe: Everything that the run depends on.
    """

    claim: str
    setting: str
    recipe: Recipe


def fingerprint(recipe: Recipe) -> str:
    """Return the hash of a recipe without its name and the place of the runs, in 8 hexadecimal digits.

    Settings at their defaults do not count, so that a recipe keeps its hash when recipes get new settings. A
    setting whose default changes must get another name: else trainings with the old default count as those
    with the new one.
    """
    start_from = "/".join(Path(recipe.start_from).parts[-2:])
    changed = {
        field.name: value
        for field in fields(recipe)
        if (value := getattr(recipe, field.name)) != field.default
    }
    settings = changed | {"name": "", "start_from": start_from}
    return hashlib.sha256(repr(sorted(settings.items())).encode()).hexdigest()[:8]
