"""The state of a timed run, and the files from which another machine can resume it."""

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from stereoweave.errors import FormatError, StereoweaveError
from stereoweave.io.files import replacing
from stereoweave.learn import checkpoint
from stereoweave.learn.checkpoint import Checkpoint, Weights
from stereoweave.learn.recipe import Recipe
from stereoweave.learn.training.model_state import ModelState

# A checkpoint that `stereoweave train` and `export` accept, the optimiser's state, which the checkpoint does
# not contain, and the progress.
NETWORK_FILE, OPTIMISER_FILE, PROGRESS_FILE = "network.pt", "optimiser.pt", "progress.json"


@dataclass(frozen=True, kw_only=True)
class RunProgress:
    """Progress of a timed run.

    Attributes:
        seconds: Time used by all commands.
        steps: Optimiser steps, including skipped steps.
        optimiser_steps: Steps since the optimiser last started without a state.
        pairs: Number of pairs trained on.
        batches: Number of the next batch to request.
        skipped: Steps skipped because the loss or the gradient was not finite.
        last_skipped: The last skipped step, counted from 0.
    """

    seconds: float = 0.0
    steps: int = 0
    optimiser_steps: int = 0
    pairs: int = 0
    batches: int = 0
    skipped: int = 0
    last_skipped: int | None = None


@dataclass(frozen=True, kw_only=True)
class ResumePoint:
    """State to resume from: checkpoint, optimiser state ({} if there is none) and progress."""

    checkpoint: Checkpoint
    optimiser: dict[str, Any]
    progress: RunProgress


def find_resume_point(recipe: Recipe, out: Path, earlier: Path | None, commit: str) -> ResumePoint:
    """Return the state of the run in `out` or `earlier`, whichever is further ahead, or of a new run.

    Raises:
        FormatError: If a file is broken or missing, or `start_from` shares no weights with the network.
        StereoweaveError: If the run trains another network.
    """
    if earlier and not (earlier / PROGRESS_FILE).exists():
        raise FormatError(
            f"{earlier}: expected {PROGRESS_FILE} from an earlier command, found none; copy all of that "
            "command's files"
        )
    folders = [folder for folder in (out, earlier) if folder and (folder / PROGRESS_FILE).exists()]
    found = [(read_progress(folder / PROGRESS_FILE), folder) for folder in folders]
    if not found:
        return ResumePoint(
            checkpoint=checkpoint.make_initial(recipe, commit), optimiser={}, progress=RunProgress()
        )
    progress, folder = max(found, key=lambda one: one[0].seconds)
    last = checkpoint.load(folder / NETWORK_FILE)
    if last.recipe.model != recipe.model:
        raise StereoweaveError(
            f"{folder / NETWORK_FILE}: expected a run of {recipe.model}, found a run of {last.recipe.model}; "
            "use another folder"
        )
    if last.recipe.trained != recipe.trained:
        raise StereoweaveError(
            f"{folder / NETWORK_FILE}: expected trained = {list(recipe.trained)}, found "
            f"{list(last.recipe.trained)}; use another folder"
        )
    optimiser = _read_optimiser(folder / OPTIMISER_FILE)
    if not optimiser:
        progress = replace(progress, optimiser_steps=0)
    state = replace(last, recipe=recipe, commit=commit)
    return ResumePoint(checkpoint=state, optimiser=optimiser, progress=progress)


def read_progress(path: Path) -> RunProgress:
    """Read the progress of a timed run. Raises FormatError if the file holds anything else."""
    try:
        return RunProgress(**json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise FormatError(
            f"{path}: expected the progress of a timed run, found unexpected contents ({error})"
        ) from error


def _read_optimiser(path: Path) -> dict[str, Any]:
    """Read the optimiser's state; {} if the file was not copied."""
    return torch.load(path, map_location="cpu", weights_only=True) if path.exists() else {}


class TimedRun(ModelState):
    """The state of a timed run on one device."""

    def __init__(self, start: Checkpoint, optimiser: dict[str, Any], device: torch.device) -> None:
        update_average = get_ema_multi_avg_fn(1 - 1 / start.recipe.averaged_steps)  # type: ignore[no-untyped-call]
        super().__init__(start, device, update_average, optimiser)
        self.device = device
        self.bfloat16 = device.type == "cuda" and torch.cuda.is_bf16_supported()
        # With a count of 0, the first update would copy the weights. The count stays on the CPU, because
        # reading it from the GPU would wait.
        self.averaged.n_averaged = torch.ones((), dtype=torch.long)

    def move_to_device(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Move a batch from `Painters` to the device, and scale its images to 0..1."""
        there = {name: value.to(self.device, non_blocking=True) for name, value in batch.items()}
        return there | {side: there[side].float() / 255 for side in ("left", "right")}

    @torch.no_grad()
    def loss(self, batch: dict[str, Tensor], bfloat16: bool) -> float:
        """Return the loss of a batch in the given precision, without training on it.

        Random numbers are those of seed 0, so that the losses of two precisions can be compared.
        """
        self.prepare_to_train()
        with torch.random.fork_rng():
            torch.manual_seed(0)
            value = float(self._loss(batch, bfloat16))
        self._restore_statistics()
        return value

    @contextmanager
    def undone(self) -> Iterator[None]:
        """Undo all steps of the block at its end: weights, average, statistics and optimiser."""
        parts: tuple[Any, ...] = self.network, self.averaged, self.optimiser
        states = [deepcopy(part.state_dict()) for part in parts]
        yield
        for part, state in zip(parts, states, strict=True):
            part.load_state_dict(state)

    def begin(self, batch: dict[str, Tensor]) -> Tensor:
        """Compute a step's gradient. Returns the step's loss; on a GPU, both are computed asynchronously."""
        self.prepare_to_train()
        self.objective.check(batch)
        self.optimiser.zero_grad()
        loss = self._loss(batch, self.bfloat16)
        loss.backward()  # type: ignore[no-untyped-call]
        return loss.detach()

    def finish(self, loss: Tensor, learning_rate: float) -> float:
        """Take the step if the loss and gradient are finite. Returns the loss; NaN for a skipped step."""
        norm = self.clip_gradient()
        value, length = torch.stack([loss.float(), norm.float()]).tolist()
        if not (math.isfinite(value) and math.isfinite(length)):
            self._restore_statistics()
            return math.nan
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate
        self.optimiser.step()
        self.averaged.update_parameters(self.network)
        return value

    @torch.no_grad()
    def scores(self, held_out: Any) -> dict[str, float]:
        """Return the scores of the averaged network on held-out pairs."""
        return self.objective.scores(self.averaged.module, held_out, self.device)

    def save(self, folder: Path, progress: RunProgress, hours: float, scores: dict[str, float]) -> None:
        """Write the network, the optimiser and the progress, each atomically.

        Raises:
            StereoweaveError: If a weight is not finite; the previous files are kept.
        """
        weights, averaged = _copy_to_cpu(self.network), _copy_to_cpu(self.averaged.module)
        if not all(bool(value.isfinite().all()) for value in (*weights.values(), *averaged.values())):
            raise StereoweaveError(
                f"step {progress.steps}: expected finite weights, found NaN or infinity; lower the learning "
                f"rate, and resume from the last checkpoint in {folder}"
            )
        state = replace(
            self.start, step=progress.steps, weights=weights, averaged=averaged, hours=hours, scores=scores
        )
        checkpoint.save(state, folder / NETWORK_FILE)
        with replacing(folder / OPTIMISER_FILE) as temporary:
            torch.save(self.optimiser.state_dict(), temporary)
        with replacing(folder / PROGRESS_FILE) as temporary:
            temporary.write_text(json.dumps(asdict(progress)) + "\n", encoding="utf-8")

    def _loss(self, batch: dict[str, Tensor], bfloat16: bool) -> Tensor:
        with torch.autocast(self.device.type, torch.bfloat16, enabled=bfloat16):
            predicted = self.objective.predict(self.network, batch)
        return torch.stack(list(self.objective.losses(predicted, batch).values())).sum()

    @torch.no_grad()
    def _restore_statistics(self) -> None:
        """Overwrite the network's batch-norm statistics with the average's, which are always finite."""
        for value, kept in zip(self.network.buffers(), self.averaged.module.buffers(), strict=True):
            value.copy_(kept)


def _copy_to_cpu(network: nn.Module) -> Weights:
    return {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
