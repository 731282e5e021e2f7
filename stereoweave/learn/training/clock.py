"""Elapsed time of a run that spans several commands, and its learning-rate schedule."""

from dataclasses import dataclass

from stereoweave.learn.recipe import Recipe

# Reserved at the end of a command for validation and the last checkpoint.
RESERVE_S = 20.0


@dataclass(frozen=True, kw_only=True)
class RunClock:
    """Elapsed and remaining time of a run. Each `now_s` is a value of `time.monotonic`.

    Attributes:
        began_s: Start of this command.
        used_s: Seconds used by earlier commands.
        minutes: Time limit of this command.
        total_minutes: Time limit of all commands together.
    """

    began_s: float
    used_s: float = 0.0
    minutes: float
    total_minutes: float

    def elapsed_s(self, now_s: float) -> float:
        """Return the time that the run has used so far, in seconds."""
        return self.used_s + now_s - self.began_s

    def elapsed_share(self, now_s: float) -> float:
        """Return the used share of the run's time, 0 to 1. At 1, the last command stops training."""
        return min(self.elapsed_s(now_s) / (60 * self.total_minutes - RESERVE_S), 1.0)

    def remaining_s(self, now_s: float) -> float:
        """Return the time left to train in this command, in seconds; negative when overdue."""
        of_run = 60 * self.total_minutes - self.elapsed_s(now_s)
        of_command = 60 * self.minutes - (now_s - self.began_s)
        return min(of_run, of_command) - RESERVE_S


def learning_rate_at(recipe: Recipe, optimiser_steps: int, share: float) -> float:
    """Return the learning rate, with a linear warm-up over steps, a constant phase and a linear decay to 0.

    Args:
        recipe: Recipe of the run. The decay takes up a share of `cool_down_steps / steps` of the time.
        optimiser_steps: Steps since the optimiser last started without a state.
        share: Share of the run's time used so far.
    """
    warm_up = (optimiser_steps + 1) / max(recipe.warm_up_steps, 1)
    cool_down = (1 - share) * recipe.steps / max(recipe.cool_down_steps, 1)
    return recipe.learning_rate * min(warm_up, cool_down, 1.0)


def is_cooling_down(recipe: Recipe, share: float) -> bool:
    """Return whether the learning rate decays at this share of the time."""
    return (1 - share) * recipe.steps < recipe.cool_down_steps
