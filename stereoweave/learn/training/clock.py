"""The time of a run that is done in several commands, and the learning rate along it."""

from dataclasses import dataclass

from stereoweave.learn.recipe import Recipe

# The end of a command is for the validation and the last checkpoint.
RESERVE_S = 20.0


@dataclass(frozen=True, kw_only=True)
class RunClock:
    """How much of a run's time is used. Times `now_s` are those of `time.monotonic`.

    Attributes:
        began_s: When this command began.
        used_s: By the commands before.
        minutes: Of this command.
        total_minutes: Of all commands.
    """

    began_s: float
    used_s: float = 0.0
    minutes: float
    total_minutes: float

    def used_at(self, now_s: float) -> float:
        """Seconds of the run that are used."""
        return self.used_s + now_s - self.began_s

    def share_at(self, now_s: float) -> float:
        """Share of the run's time that is used, 0 to 1; 1 is where the last command stops training."""
        return min(self.used_at(now_s) / (60 * self.total_minutes - RESERVE_S), 1.0)

    def left_at(self, now_s: float) -> float:
        """Seconds that this command may still train; below 0 when it is late."""
        of_run = 60 * self.total_minutes - self.used_at(now_s)
        of_command = 60 * self.minutes - (now_s - self.began_s)
        return min(of_run, of_command) - RESERVE_S


def learning_rate_at(recipe: Recipe, optimiser_steps: int, share: float) -> float:
    """The rate: up along the recipe's warm-up steps, constant, then down to 0 at the end of the time.

    Args:
        recipe: It cools down over the share `cool_down_steps / steps` of the time.
        optimiser_steps: Since the optimiser began without a state.
        share: Of the run's time that is used.
    """
    warm_up = (optimiser_steps + 1) / max(recipe.warm_up_steps, 1)
    cool_down = (1 - share) * recipe.steps / max(recipe.cool_down_steps, 1)
    return recipe.learning_rate * min(warm_up, cool_down, 1.0)


def is_cooling_down(recipe: Recipe, share: float) -> bool:
    """Whether the rate falls at that share of the time."""
    return (1 - share) * recipe.steps < recipe.cool_down_steps
