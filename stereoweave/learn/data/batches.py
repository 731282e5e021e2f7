"""Training batches: selection, cropping and collation of their pairs."""

import numpy as np
import torch
from torch.utils.data import Dataset

from stereoweave.errors import StereoweaveError
from stereoweave.learn.data.augment import augment, crop, pad
from stereoweave.learn.data.sources import MixedSource, OrderedSource, PairSource
from stereoweave.learn.distributed import ProcessRank
from stereoweave.learn.recipe import Recipe
from stereoweave.stereo import Sample


class Batches(Dataset[dict[str, torch.Tensor]]):
    """Dataset of one batch per step, or of one rank's share of each batch.

    A micro-batch depends only on the seed, the step and its index in the step, not on the process that
    requests it or on the order of the requests.
    """

    def __init__(self, recipe: Recipe, pairs: PairSource, rank: ProcessRank | None = None) -> None:
        self.recipe, self.pairs = recipe, pairs
        self.mix = pairs if isinstance(pairs, MixedSource) else MixedSource((pairs,), (1.0,))
        self.parts = (rank or ProcessRank()).own_micro_batches(recipe.micro_batches)
        self._draw(0)

    def __getitem__(self, step: int) -> dict[str, torch.Tensor]:
        chosen = self.list_pairs(step)
        size = len(chosen) // self.recipe.micro_batches
        return collate(
            [
                sample
                for part in self.parts
                for sample in self._crop(chosen[part * size : (part + 1) * size], self.key(step, part))
            ]
        )

    def key(self, step: int, part: int) -> tuple[int, ...]:
        """Return the seed for all random numbers of a micro-batch.

        The seed is (seed, step, 0, 2 * part). Trailing zeros do not change a seed, so the first micro-batch
        gets the same random numbers as a whole step did before micro-batches existed. Seeds with another
        third number, or an odd fourth one, are those of the order of the pairs and of the choice of sets.
        """
        return self.recipe.seed, step, 0, 2 * part

    def list_pairs(self, step: int) -> list[int]:
        """Return the indices of a step's pairs. The pairs of a set repeat only after all have been drawn."""
        first, end = step * self.recipe.batch, (step + 1) * self.recipe.batch
        while len(self._drawn) < end:
            self._draw(2 * len(self._drawn) + end)
        return [self._index(int(self._drawn[i]), int(self._turns[i])) for i in range(first, end)]

    def names(self, step: int) -> list[str]:
        """Return the names of a step's pairs, for error messages."""
        return [self.pairs.name(index) for index in self.list_pairs(step)]

    def _draw(self, places: int) -> None:
        """Draw a set for each of the first `places` pairs, and count how often that set was drawn before."""
        self._drawn = self.mix.draw_sets(places, np.random.default_rng((self.recipe.seed, 0, 0, 1)))
        self._turns = np.zeros(places, np.int64)
        for which in range(len(self.mix.sets)):
            places_of_set = np.flatnonzero(self._drawn == which)
            self._turns[places_of_set] = np.arange(len(places_of_set))

    def _crop(self, indices: list[int], key: tuple[int, ...]) -> list[Sample]:
        rng, size = np.random.default_rng(key), self.recipe.crop_size
        samples = (read_known(self.pairs, index) for index in indices)
        if self.recipe.augment:
            crops = [augment(sample, *size, rng, self.recipe.offset_share) for sample in samples]
            share = self.recipe.padded_share
            return [pad(one, rng) if share and rng.random() < share else one for one in crops]
        return [crop(sample, *size, rng) for sample in samples]

    def _index(self, which: int, turn: int) -> int:
        """Return the index of the pair for draw `turn` from set `which`; both are counted from 0."""
        one = self.mix.sets[which]
        epoch, place = divmod(turn, one.count)
        rng = np.random.default_rng((self.recipe.seed, epoch, 1 + which))
        order = one.order(rng) if isinstance(one, OrderedSource) else rng.permutation(one.count)
        return self.mix.first_index(which) + int(order[place])


class CaughtBatches(Dataset[dict[str, torch.Tensor] | StereoweaveError]):
    """Batches that return errors as values instead of raising them.

    If a loader process raised an error, PyTorch would replace the message with a traceback.
    """

    def __init__(self, batches: Batches) -> None:
        self.batches = batches

    def __getitem__(self, step: int) -> dict[str, torch.Tensor] | StereoweaveError:
        try:
            return self.batches[step]
        except StereoweaveError as error:
            return error


def read_known(pairs: PairSource, index: int) -> Sample:
    """Read a sample. Raises StereoweaveError if no pixel has a known disparity."""
    sample = pairs[index]
    if not np.isfinite(sample.disparity_px).any():
        raise StereoweaveError(
            f"{pairs.name(index)}: expected at least one pixel with known disparity, found none; "
            "remove the pair from the dataset"
        )
    return sample


def collate(samples: list[Sample]) -> dict[str, torch.Tensor]:
    """Collate samples into a batch, a dictionary of tensors.

    Images are [B, 3, H, W] in 0..1. Maps are [2B, 1, H, W]; the maps of the left views come first, then the
    mirrored maps of the right views. If every sample has a camera, the batch also contains
    `focal_baseline_px_m` and `doffs_px`, both [B, 1, 1, 1].

    Raises:
        StereoweaveError: The samples differ in size.
    """
    sizes = sorted({sample.left.shape[:2] for sample in samples})
    if len(sizes) > 1:
        raise StereoweaveError(
            f"batch: expected pairs of the same size, found {' and '.join(f'{w}x{h}' for h, w in sizes)}; "
            "crop them to the same crop_size"
        )

    def images(side: str) -> torch.Tensor:
        stacked = np.stack([getattr(sample, side) for sample in samples])
        return torch.from_numpy(stacked).permute(0, 3, 1, 2).float() / 255

    def maps(name: str) -> torch.Tensor:
        lefts = [getattr(sample, name) for sample in samples]
        rights = [getattr(sample, f"right_{name}")[:, ::-1] for sample in samples]
        return torch.from_numpy(np.stack(lefts + rights))[:, None]

    batch = {
        "left": images("left"),
        "right": images("right"),
        "disparity_px": maps("disparity_px"),
        "occluded": maps("occluded"),
    }
    cameras = [sample.camera for sample in samples if sample.camera is not None]
    if len(cameras) == len(samples):
        products = [camera.focal_px * camera.baseline_m for camera in cameras]
        batch["focal_baseline_px_m"] = torch.tensor(products).view(-1, 1, 1, 1)
        batch["doffs_px"] = torch.tensor([camera.doffs_px for camera in cameras]).view(-1, 1, 1, 1)
    return batch


def split_batch(batch: dict[str, torch.Tensor], parts: int) -> list[dict[str, torch.Tensor]]:
    """Split a collated batch into equal parts that keep the order of its pairs."""
    pairs = len(batch["left"])

    def part(values: torch.Tensor, which: int) -> torch.Tensor:
        # The maps of the left views come before those of the right views.
        return torch.unflatten(values, 0, (len(values) // pairs, parts, -1))[:, which].flatten(0, 1)

    return [{name: part(values, which) for name, values in batch.items()} for which in range(parts)]
