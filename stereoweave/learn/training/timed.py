"""Training for a fixed time, on a machine that is available only for short commands.

Unlike `train`, which counts steps, each command here ends on time. The learning rate reaches 0 when the
minutes of all commands are used up. Each command resumes from the files of the previous command.
"""

import math
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from stereoweave.errors import StereoweaveError
from stereoweave.io.files import make_folder
from stereoweave.learn import checkpoint
from stereoweave.learn.data.painters import Painters, make_cool_down_recipe
from stereoweave.learn.data.pair_cache import CachedPairs
from stereoweave.learn.data.sources import PairSource, open_sources
from stereoweave.learn.recipe import Recipe
from stereoweave.learn.training.clock import RESERVE_S, RunClock, is_cooling_down, learning_rate_at
from stereoweave.learn.training.model_state import STEPS_BETWEEN_SKIPS
from stereoweave.learn.training.timed_run import NETWORK_FILE, RunProgress, TimedRun, find_resume_point

Report = Callable[[str], None]

_REPORT_EVERY_S, _SAVE_EVERY_S = 15.0, 60.0
_TRIED_STEPS = 3
# Largest accepted relative error of a loss computed in bfloat16, which has 8 bits of precision.
_BFLOAT16_SHARE = 0.05


@dataclass(frozen=True, kw_only=True)
class TimedCommand:
    """One command of a timed run.

    Attributes:
        out: Folder to write to, and to resume from if it holds a run.
        earlier: Folder with the files of an earlier command. The run that is further ahead, in this folder or
            in `out`, is resumed.
        began_s: Start of the command, as a value of `time.monotonic`.
        minutes: Time limit of this command.
        total_minutes: Time limit of all commands together.
        device: "cuda" or "cpu".
        processes: Number of processes that make batches.
        cool_down_crop: Height and width of the crops during the cool-down. Default: as in the recipe.
        commit: Commit of the code, for a machine without git. Default: found with git.
    """

    out: Path
    earlier: Path | None = None
    began_s: float
    minutes: float
    total_minutes: float
    device: str
    processes: int
    cool_down_crop: tuple[int, int] | None = None
    commit: str = ""


@dataclass(frozen=True)
class _Snapshot:
    """Time and counters at one moment during training."""

    at_s: float
    pairs: int = 0
    taken: int = 0
    late: int = 0


def train_by_clock(recipe: Recipe, command: TimedCommand, report: Report) -> RunProgress:
    """Train for the duration of one command. Returns the run's progress.

    Raises:
        StereoweaveError: If the files to resume from are invalid, no batches can be made, or losses are not
            finite.
    """
    make_folder(command.out)
    start = find_resume_point(
        recipe, command.out, command.earlier, command.commit or checkpoint.find_commit()
    )
    clock = RunClock(
        began_s=command.began_s,
        used_s=start.progress.seconds,
        minutes=command.minutes,
        total_minutes=command.total_minutes,
    )
    if clock.remaining_s(time.monotonic()) <= 0:
        report(f"all {command.total_minutes:g} minutes are used up; {command.out} is unchanged")
        return start.progress
    recipes = [
        recipe,
        *([make_cool_down_recipe(recipe, command.cool_down_crop)] if command.cool_down_crop else []),
    ]
    with ExitStack() as stack:
        kept = Path(stack.enter_context(TemporaryDirectory()))
        pinned = command.device == "cuda"
        painters = Painters(recipes, kept, command.processes, start.progress.batches, pinned)
        stack.enter_context(painters)
        run = TimedRun(start.checkpoint, start.optimiser, torch.device(command.device))
        loop = _TimedLoop(run, painters, clock, command.out, report)
        loop.train_from(start.progress)
        loop.finish(open_sources(recipe, kept)[1])
        return loop.progress


class _TimedLoop:
    """The training loop of one command."""

    def __init__(self, run: TimedRun, painters: Painters, clock: RunClock, out: Path, report: Report) -> None:
        self.run, self.painters, self.clock, self.out, self.report = run, painters, clock, out, report
        self.recipe = run.start.recipe
        self.progress, self.losses = RunProgress(), list[float]()

    def train_from(self, progress: RunProgress) -> None:
        """Train until the command's time is up, with periodic reports and checkpoints."""
        self.progress = progress
        batch = self._smoke_test()
        self.reported = self._take_snapshot()
        while self.clock.remaining_s(time.monotonic()) > 0:
            share = self.clock.elapsed_share(time.monotonic())
            rate = learning_rate_at(self.recipe, self.progress.optimiser_steps, share)
            if is_cooling_down(self.recipe, share):
                self.painters.switch(len(self.painters.recipes) - 1)
            pairs, loss = len(batch["left"]), self.run.begin(batch)
            # The next batch is taken while the GPU is still computing the gradient.
            batch = self.run.move_to_device(self.painters.take())
            self._count(pairs, self.run.finish(loss, rate))
            if time.monotonic() - self.reported.at_s > _REPORT_EVERY_S:
                self._report(rate)
            if time.monotonic() - self.saved_s > _SAVE_EVERY_S:
                self._save({})

    def finish(self, held_out: PairSource) -> None:
        """Score the run unless time or held-out pairs are lacking, save it, and report the results."""
        too_late = self.clock.remaining_s(time.monotonic()) < -RESERVE_S
        if too_late or (isinstance(held_out, CachedPairs) and held_out.missing()):
            self.report("not scored: out of time" if too_late else "not scored: no held-out pairs")
            return self._save({})
        scores = self.run.scores(held_out)
        self._save(scores)
        self.report("held-out pairs: " + "  ".join(f"{name} {score:.4g}" for name, score in scores.items()))
        for file in sorted(self.out.iterdir()):
            self.report(f"{file}  {file.stat().st_size / 2**20:.1f} MiB")
        seconds, progress = self.clock.elapsed_s(time.monotonic()), self.progress
        self.report(
            f"{seconds / 60:.1f} of {self.clock.total_minutes:g} minutes used up: {progress.steps} steps, "
            f"{progress.pairs} pairs, {progress.skipped} steps skipped"
        )
        return None

    def _smoke_test(self) -> dict[str, torch.Tensor]:
        """Run every part of the training once, on the first batch, to reveal faults. Returns the batch.

        bfloat16 is disabled if its loss differs too much from the loss in float32.
        """
        batch = self.run.move_to_device(self.painters.take())
        plain = self.run.loss(batch, bfloat16=False)
        self.report(f"{self._format_elapsed()}  first batch ready; its loss is {plain:.4g}")
        if self.run.bfloat16:
            rounded = self.run.loss(batch, bfloat16=True)
            self.run.bfloat16 = abs(rounded - plain) < _BFLOAT16_SHARE * abs(plain)
            taken = "bfloat16" if self.run.bfloat16 else "float32"
            self.report(f"in bfloat16 the loss is {rounded:.4g}; training in {taken}")
        pairs_per_s = len(batch["left"]) / self._measure_step_s(batch)
        self._save({})
        checkpoint.load(self.out / NETWORK_FILE)
        self.report(
            f"{self._format_elapsed()}  smoke test passed: files can be written and read, and the network "
            f"alone processes {pairs_per_s:.1f} pairs/s"
        )
        return batch

    def _measure_step_s(self, batch: dict[str, torch.Tensor]) -> float:
        """Return the mean time of a few steps, after one warm-up step. The steps are undone."""
        with self.run.undone():
            for step in range(1 + _TRIED_STEPS):
                if step == 1:
                    began_s = time.monotonic()
                if math.isnan(self.run.finish(self.run.begin(batch), 0.0)):
                    raise StereoweaveError(
                        "the first batch: expected a finite loss and gradient, found NaN or infinity; "
                        "start from other weights"
                    )
            return (time.monotonic() - began_s) / _TRIED_STEPS

    def _count(self, pairs: int, loss: float) -> None:
        before = self.progress
        self.progress = replace(
            before,
            steps=before.steps + 1,
            optimiser_steps=before.optimiser_steps + 1,
            pairs=before.pairs + pairs,
        )
        if math.isnan(loss):
            self._skip(before)
        else:
            self.losses.append(loss)

    def _skip(self, before: RunProgress) -> None:
        self.report(f"step {before.steps}: the loss or its gradient is not finite; skipped")
        last = before.last_skipped
        if last is not None and before.steps - last < STEPS_BETWEEN_SKIPS:
            raise StereoweaveError(
                f"steps {last} and {before.steps}: expected a finite loss and gradient, "
                f"found NaN or infinity; lower the learning rate, and resume from {self.out}"
            )
        self.progress = replace(self.progress, skipped=before.skipped + 1, last_skipped=before.steps)

    def _report(self, rate: float) -> None:
        before, self.reported = self.reported, self._take_snapshot()
        late = (self.reported.late - before.late) / max(self.reported.taken - before.taken, 1)
        speed = (self.reported.pairs - before.pairs) / (self.reported.at_s - before.at_s)
        left_s = 60 * self.clock.total_minutes - self.clock.elapsed_s(self.reported.at_s)
        self.report(
            f"{self._format_elapsed()}  step {self.progress.steps}  loss {np.mean(self.losses):.4g}  "
            f"rate {rate:.3g}  {speed:.1f} pairs/s  late {100 * late:.0f} %  cuts {self.painters.cuts:.1f}  "
            f"{self.progress.pairs + speed * left_s:.3g} pairs in the end"
        )
        self.painters.adapt(late)
        self.losses.clear()

    def _save(self, scores: dict[str, float]) -> None:
        self.saved_s = time.monotonic()
        self.progress = replace(
            self.progress, seconds=self.clock.elapsed_s(self.saved_s), batches=self.painters.number
        )
        hours = self.run.start.hours + (self.saved_s - self.clock.began_s) / 3600
        self.run.save(self.out, self.progress, hours, scores)

    def _take_snapshot(self) -> _Snapshot:
        return _Snapshot(time.monotonic(), self.progress.pairs, self.painters.taken, self.painters.late)

    def _format_elapsed(self) -> str:
        return f"{self.clock.elapsed_s(time.monotonic()):5.0f} s"
