from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from learn_examples import CAMERA, PAIR_SIZE, RECIPE, Listed, box_before_a_wall, complaint

from stereoweave.learn.data.batches import Batches, collate, read_known, split_batch
from stereoweave.learn.data.pair_cache import CachedPairs
from stereoweave.learn.data.sources import MixedSource
from stereoweave.learn.distributed import ProcessRank


def samples(count, **changes):
    return [replace(box_before_a_wall(np.random.default_rng(seed)), **changes) for seed in range(count)]


@pytest.fixture(scope="module")
def pairs():
    return Listed(samples(4))


@dataclass(frozen=True)
class Backwards(Listed):
    """Pairs that are fastest to read from last to first."""

    def order(self, rng):
        return np.arange(self.count)[::-1]


def mix_of(*counts, weights):
    return MixedSource(tuple(Listed(samples(1) * count) for count in counts), weights)


def chosen_of(mix, steps, **changes):
    batches = Batches(replace(RECIPE, **changes), mix)
    return [index for step in range(steps) for index in batches.list_pairs(step)]


def test_every_pair_is_drawn_once_before_any_is_repeated():
    recipe = replace(RECIPE, pairs=7, batch=3)
    batches = Batches(recipe, CachedPairs(Path("unused"), 0, recipe.pairs, PAIR_SIZE))
    chosen = [index for step in range(7) for index in batches.list_pairs(step)]
    epochs = [chosen[:7], chosen[7:14], chosen[14:]]
    assert all(sorted(epoch) == list(range(7)) for epoch in epochs)
    assert epochs[0] != epochs[1]


def test_the_pairs_of_a_step_come_in_the_order_of_their_seed_and_epoch():
    """Keep the order from before sets could be mixed, so that old runs can be resumed and compared."""
    batches = Batches(replace(RECIPE, batch=3, seed=5), Listed(samples(1) * 7))
    orders = [np.random.default_rng((5, epoch, 1)).permutation(7) for epoch in range(3)]
    chosen = [index for step in range(7) for index in batches.list_pairs(step)]
    assert chosen == np.concatenate(orders).tolist()


def test_every_pair_of_each_set_of_a_mix_is_drawn_once_before_any_is_repeated():
    chosen = chosen_of(mix_of(5, 3, weights=(3.0, 1.0)), 40, batch=4)
    for own in (range(5), range(5, 8)):
        drawn = [index for index in chosen if index in own]
        epochs = [drawn[i : i + len(own)] for i in range(0, len(drawn) - len(own) + 1, len(own))]
        assert len(epochs) > 5
        assert all(sorted(epoch) == list(own) for epoch in epochs)
        assert len({tuple(epoch) for epoch in epochs}) > 1


def test_the_sets_of_a_mix_are_drawn_by_weight():
    counts = Counter(index // 10 for index in chosen_of(mix_of(10, 10, 10, weights=(5, 4, 1)), 100, batch=40))
    # For 4,000 draws the deviations are 32, 31 and 19.
    assert [counts[which] for which in range(3)] == pytest.approx([2000, 1600, 400], abs=130)


def test_a_step_of_a_mix_depends_on_the_seed_and_the_step_alone():
    mix = mix_of(5, 3, weights=(1.0, 1.0))
    whole = chosen_of(mix, 20, batch=4)
    assert Batches(replace(RECIPE, batch=4), mix).list_pairs(13) == whole[52:56]
    assert chosen_of(mix, 20, batch=4, seed=1) != whole


def test_a_set_is_read_in_its_own_order():
    mix = MixedSource((Listed(samples(1) * 5), Backwards(samples(1) * 4)), (1.0, 1.0))
    drawn = [index for index in chosen_of(mix, 20) if index >= 5]
    assert drawn == [8 - i % 4 for i in range(len(drawn))]


def test_a_batch_of_a_mix_has_the_pairs_of_its_sets_and_names_them(pairs):
    cameras = Listed(samples(3, camera=CAMERA))
    mix = MixedSource((pairs, cameras), (1.0, 1.0))
    batches = Batches(replace(RECIPE, augment=False, crop_size=PAIR_SIZE, batch=8), mix)
    chosen, batch = batches.list_pairs(0), batches[0]
    assert min(chosen) < 4 <= max(chosen)
    own = [(pairs, index) if index < 4 else (cameras, index - 4) for index in chosen]
    for place, (source, index) in enumerate(own):
        np.testing.assert_array_equal(batch["disparity_px"][place, 0], source[index].disparity_px)
        found = (255 * batch["left"][place]).round().byte().permute(1, 2, 0)
        np.testing.assert_array_equal(found, source[index].left)
    assert batches.names(0) == [source.name(index) for source, index in own]
    # Not all of them have a camera.
    assert "focal_baseline_px_m" not in batch


def test_a_batch_depends_on_the_seed_and_the_step_alone(pairs):
    one, other = Batches(RECIPE, pairs), Batches(RECIPE, pairs)
    other[0]
    again, first = other[1], one[1]
    assert first.keys() == again.keys()
    assert all(torch.equal(first[name].nan_to_num(-1), again[name].nan_to_num(-1)) for name in first)
    assert not torch.equal(first["left"], one[2]["left"])


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_a_share_of_the_crops_ends_in_padding(pairs, share):
    batches = Batches(replace(RECIPE, batch=4, padded_share=share), pairs)
    truths_px = torch.cat([batches[step]["disparity_px"][:4, 0] for step in range(30)])
    padded = truths_px[:, -1].isnan().all(1) | truths_px[:, :, -1].isnan().all(1)
    assert abs(padded.float().mean() - share) < 0.1 if share else not padded.any()


def test_a_batch_without_augmentation_holds_unchanged_crops(pairs):
    batches = Batches(replace(RECIPE, augment=False, crop_size=PAIR_SIZE), pairs)
    batch = batches[0]
    for place, index in enumerate(batches.list_pairs(0)):
        np.testing.assert_array_equal(batch["disparity_px"][place, 0], pairs[index].disparity_px)
        found = (255 * batch["right"][place]).round().byte().permute(1, 2, 0)
        np.testing.assert_array_equal(found, pairs[index].right)


def test_a_batch_holds_the_left_views_maps_and_then_the_mirrored_maps_of_the_right_views():
    first, second = samples(2)
    batch = collate([first, second])
    height, width = PAIR_SIZE
    assert batch.keys() == {"left", "right", "disparity_px", "occluded"}
    assert batch["left"].shape == batch["right"].shape == (2, 3, height, width)
    assert batch["left"][1, 2, 5, 7].item() == pytest.approx(second.left[5, 7, 2] / 255)
    assert batch["disparity_px"].shape == batch["occluded"].shape == (4, 1, height, width)
    np.testing.assert_array_equal(batch["disparity_px"][1, 0], second.disparity_px)
    np.testing.assert_array_equal(batch["disparity_px"][3, 0], second.right_disparity_px[:, ::-1])
    np.testing.assert_array_equal(batch["occluded"][2, 0], first.right_occluded[:, ::-1])


def test_each_sample_keeps_its_own_camera():
    first, second = samples(2, camera=CAMERA)
    second = replace(second, camera=replace(CAMERA, focal_px=60.0, doffs_px=3.0))
    batch = collate([first, second])
    # These are 120 px and 60 px times 0.2 m.
    torch.testing.assert_close(batch["focal_baseline_px_m"], torch.tensor([24.0, 12.0]).view(2, 1, 1, 1))
    torch.testing.assert_close(batch["doffs_px"], torch.tensor([0.0, 3.0]).view(2, 1, 1, 1))


def test_a_batch_with_one_sample_without_a_camera_has_no_cameras():
    first, second = samples(2, camera=CAMERA)
    assert "focal_baseline_px_m" not in collate([first, replace(second, camera=None)])


def test_a_batch_of_mixed_sizes_is_refused():
    mixed = [box_before_a_wall(np.random.default_rng(0), size) for size in ((64, 96), (32, 48), (64, 96))]
    assert complaint(collate, mixed) == (
        "batch: expected pairs of the same size, found 48x32 and 96x64; crop them to the same crop_size"
    )


def test_the_error_for_a_pair_without_a_known_pixel_names_it():
    unknown_px = np.full(PAIR_SIZE, np.nan, np.float32)
    pairs = Listed([*samples(2), *samples(1, disparity_px=unknown_px)])
    assert read_known(pairs, 1) is pairs[1]
    assert complaint(read_known, pairs, 2) == (
        "sample 2: expected at least one pixel with known disparity, found none; "
        "remove the pair from the dataset"
    )
    batches = Batches(replace(RECIPE, batch=3), pairs)
    assert "sample 2: " in complaint(batches.__getitem__, 0)


def test_one_known_pixel_is_enough():
    disparity_px = np.full(PAIR_SIZE, np.nan, np.float32)
    disparity_px[10, 20] = 0
    (sample,) = samples(1, disparity_px=disparity_px)
    assert read_known(Listed([sample]), 0) is sample


def test_a_crop_larger_than_the_pictures_is_refused(pairs):
    batches = Batches(replace(RECIPE, augment=False, crop_size=(64, 112)), pairs)
    assert complaint(batches.__getitem__, 0) == (
        "crop_size = [64, 112], expected at most [64, 96], the size of the pictures; use a smaller crop"
    )


@dataclass(frozen=True)
class Watched(Listed):
    """Pairs that record which of them are read."""

    read: list[int]

    def __getitem__(self, index):
        self.read.append(index)
        return self.samples[index]


def shares_of(recipe, count, step):
    """Return the batch that each of `count` processes makes for a step, and the pairs that it reads."""
    watched = [Watched(samples(1) * 12, []) for _ in range(count)]
    batches = [Batches(recipe, pairs, ProcessRank(rank, count)) for rank, pairs in enumerate(watched)]
    return [one[step] for one in batches], [one.read for one in watched]


def assert_same_batches(one, other):
    assert one.keys() == other.keys()
    assert all(torch.equal(one[name].nan_to_num(-1), other[name].nan_to_num(-1)) for name in one)


def test_each_process_reads_only_its_own_consecutive_pairs_of_a_step():
    recipe = replace(RECIPE, batch=6, micro_batch=1, seed=5)
    # Step 1 has the last six of 12 pairs in this order; three processes make two micro-batches each.
    order = np.random.default_rng((5, 0, 1)).permutation(12).tolist()
    _, read = shares_of(recipe, 3, 1)
    assert read == [order[6:8], order[8:10], order[10:12]]


@pytest.mark.parametrize("count", [2, 4])
def test_several_processes_make_the_same_micro_batches_as_a_single_process(count):
    recipe = replace(RECIPE, batch=8, micro_batch=2)
    ((whole,), _), (shares, _) = shares_of(recipe, 1, 3), shares_of(recipe, count, 3)
    parts = [part for share in shares for part in split_batch(share, 4 // count)]
    for one, other in zip(parts, split_batch(whole, 4), strict=True):
        assert_same_batches(one, other)


def test_the_first_micro_batch_has_the_crops_of_a_batch_that_is_not_split(pairs):
    recipe = replace(RECIPE, batch=2)
    parted = split_batch(Batches(replace(recipe, micro_batch=1), pairs)[4], 2)
    whole = Batches(recipe, pairs)[4]
    assert torch.equal(parted[0]["left"][0], whole["left"][0])
    # The second micro-batch has a generator of its own.
    assert not torch.equal(parted[1]["left"][0], whole["left"][1])


def test_zeros_after_seed_and_step_do_not_change_the_draws():
    """Recipes without micro-batches depend on this for the crops that they had before micro-batches."""
    key = Batches(replace(RECIPE, seed=3), Listed(samples(2))).key(7, 0)
    assert np.random.default_rng(key).random() == np.random.default_rng((3, 7)).random()


def test_the_parts_of_a_batch_equal_its_samples_collated_separately(pairs):
    for one, other in zip(
        split_batch(collate(pairs.samples), 2), (pairs.samples[:2], pairs.samples[2:]), strict=True
    ):
        assert_same_batches(one, collate(other))
    assert_same_batches(split_batch(collate(pairs.samples), 1)[0], collate(pairs.samples))
