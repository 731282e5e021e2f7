"""Description of one training run of an experiment."""

from dataclasses import dataclass

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
