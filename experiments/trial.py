"""Description of one training of an experiment."""

from dataclasses import dataclass

from stereoweave.learn.recipe import Recipe


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One training of an experiment.

    Attributes:
        claim: Claim or design choice that the training tests.
        setting: Name of the training, unique within its claim.
        recipe: Everything that the training depends on.
    """

    claim: str
    setting: str
    recipe: Recipe
