"""A training of an experiment."""

from dataclasses import dataclass

from stereoweave.learn.recipe import Recipe


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One training of an experiment.

    Attributes:
        claim: The claim or choice that it tests.
        setting: Its name among the trainings of that claim.
        recipe: Everything that the training depends on.
    """

    claim: str
    setting: str
    recipe: Recipe
