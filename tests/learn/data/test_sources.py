from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dataset_examples import shades, write_map, write_picture
from learn_examples import CAMERA, PAIR_SIZE, RECIPE, Listed, box_before_a_wall, complaint, keep_pairs
from rich.console import Console

from stereoweave.data.packing import pack
from stereoweave.data.shards import Shards, write_shard
from stereoweave.learn.data import pair_cache as the_pairs
from stereoweave.learn.data.batches import Batches
from stereoweave.learn.data.collage import paint_training_collage
from stereoweave.learn.data.pair_cache import CachedPairs
from stereoweave.learn.data.sources import (
    VALIDATION_SEED,
    KeptPairs,
    MixedSource,
    PairSource,
    cache_pairs,
    divide_frames,
    open_held_out_sets,
    open_sources,
)

CALIBRATION = "cam0=[300 0 19.5; 0 300 15.5; 0 0 1]\ndoffs=0\nbaseline=100\nwidth=40\nheight=32\n"
FRAMES = [f"mill/{number:04d}" for number in range(40)]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Return a dataset of forty frames, 5 m away; each left picture's grey level is its frame number."""
    root = tmp_path_factory.mktemp("mill")
    for number, frame in enumerate(FRAMES):
        write_picture(root / "left" / f"{frame}.png", number)
        write_picture(root / "right" / f"{frame}.png", 100)
        write_map(root / "depth" / f"{frame}.png", [0], 5000, np.uint16)
    (root / "calib.txt").write_text(CALIBRATION)
    return root


@pytest.fixture
def recipe(root):
    return replace(RECIPE, dataset="paper", root=str(root), split="disjoint", validation_pairs=100)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """Return a folder of rendered sets: six pairs of rooms, and two of a ship beside four of a crane."""
    root = tmp_path_factory.mktemp("rendered")
    for folder, count in (("rooms", 6), ("scenes/ship", 2), ("scenes/crane", 4)):
        (root / folder).mkdir(parents=True)
        samples = (box_before_a_wall(np.random.default_rng((count, i))) for i in range(count))
        pairs = [pack(replace(sample, camera=CAMERA), {}) for sample in samples]
        write_shard(root / folder, Path(folder).name, 0, pairs)
    return root


def mixed(root, **weights):
    return replace(
        RECIPE,
        mix=tuple((name if name == "collage" else str(root / name), w) for name, w in weights.items()),
    )


def names(source):
    return [source.name(index) for index in range(source.count)]


def test_collages_are_kept_apart_from_those_for_validation(tmp_path):
    training, held_out = open_sources(RECIPE, tmp_path)
    assert training.folder == CachedPairs(tmp_path, RECIPE.seed, 4, PAIR_SIZE).folder
    assert held_out.folder == CachedPairs(tmp_path, VALIDATION_SEED, 2, PAIR_SIZE).folder
    assert training.folder != held_out.folder
    assert (training.count, held_out.count) == (4, 2)
    assert isinstance(training, PairSource)


def test_each_frame_of_a_dataset_is_trained_on_or_held_out(recipe, tmp_path):
    training, held_out = open_sources(recipe, tmp_path)
    assert isinstance(training, PairSource)
    # The last tenth of the sequence is held out.
    assert names(training) == FRAMES[:36]
    assert names(held_out) == FRAMES[36:]
    assert list(tmp_path.iterdir()) == []


def test_the_split_is_that_of_the_recipe(recipe, tmp_path):
    training, held_out = open_sources(replace(recipe, split="random"), tmp_path)
    assert sorted(names(training) + names(held_out)) == FRAMES
    assert names(held_out) != FRAMES[36:]


def test_frames_that_are_left_out_are_neither_trained_on_nor_held_out(recipe, tmp_path):
    """The disjoint split holds out the last 4 of 40 frames; a tenth of the other 36 is drawn at random."""
    training, held_out, left_out = divide_frames(replace(recipe, split="random", leave_out="disjoint"))
    assert [frame.name for frame in left_out] == FRAMES[36:]
    assert len(held_out) == 4
    assert sorted(frame.name for frame in (*training, *held_out)) == FRAMES[:36]
    opened = open_sources(replace(recipe, split="random", leave_out="disjoint"), tmp_path)
    assert [part.count for part in opened] == [32, 4]
    assert divide_frames(recipe).left_out == []


def test_a_frame_is_read_on_demand(recipe, tmp_path):
    training, _ = open_sources(recipe, tmp_path)
    sample = training[7]
    assert shades(sample) == (7, 100)
    # f B = 30 px m, at a depth of 5 m.
    np.testing.assert_allclose(sample.disparity_px[0, :2], [np.nan, 6])
    assert sample.camera.focal_px == 300


def test_a_training_frame_is_decoded_once(recipe, tmp_path):
    training, _ = open_sources(recipe, tmp_path)
    assert training[7] is training[7]


def test_pairs_beyond_the_memory_are_read_every_time(rng):
    class Counted(Listed):
        def __getitem__(self, index):
            read.append(index)
            return super().__getitem__(index)

    read, samples = [], [box_before_a_wall(rng, (8, 16), wall_px=1, box_px=2) for _ in range(3)]
    # A pixel has two colours of 3 bytes, two disparities of 4, and two occlusions of 1.
    kept = KeptPairs(Counted(samples), 2 * 8 * 16 * (6 + 8 + 2))
    assert [kept[index] for index in (0, 1, 2, 0, 1, 2)] == 2 * samples
    assert read == [0, 1, 2, 2]
    assert (kept.count, kept.name(2)) == (3, "sample 2")


@pytest.mark.parametrize(
    ("count", "chosen"), [(1, [36]), (2, [36, 39]), (3, [36, 38, 39]), (4, [36, 37, 38, 39])]
)
def test_validation_pairs_are_spread_over_the_held_out_frames(recipe, tmp_path, count, chosen):
    _, held_out = open_sources(replace(recipe, validation_pairs=count), tmp_path)
    assert names(held_out) == [FRAMES[number] for number in chosen]


def test_frames_of_validations_are_decoded_once(recipe, tmp_path):
    _, held_out = open_sources(replace(recipe, validation_pairs=2), tmp_path)
    assert held_out[1] is held_out[1]


def test_all_held_out_frames_are_returned_on_request(recipe, tmp_path):
    _, held_out = open_sources(replace(recipe, validation_pairs=1), tmp_path, whole=True)
    assert names(held_out) == FRAMES[36:]


def test_the_error_for_an_unknown_dataset_lists_the_known_ones(recipe, tmp_path):
    message = complaint(open_sources, replace(recipe, dataset="propeller"), tmp_path)
    assert message.startswith(
        "tiny: dataset = 'propeller', expected one of collage, sintel, flyingthings3d, "
    )


def test_the_error_for_a_missing_root_names_it(recipe, tmp_path):
    assert str(tmp_path / "nowhere") in complaint(
        open_sources, replace(recipe, root=str(tmp_path / "nowhere")), tmp_path
    )


def test_a_mix_has_the_pairs_of_its_sets_one_after_another(rendered, tmp_path):
    keep_pairs(tmp_path, RECIPE.seed, RECIPE.pairs)
    training, held_out = open_sources(mixed(rendered, rooms=3.0, collage=1.0), tmp_path)
    assert isinstance(training, MixedSource) and isinstance(training, PairSource)
    assert (training.count, held_out.count) == (6 + 4, 2)
    assert held_out.folder == CachedPairs(tmp_path, VALIDATION_SEED, 2, PAIR_SIZE).folder
    rooms, collages = training.sets
    assert names(training) == [*names(rooms), *names(collages)]
    assert names(rooms)[5] == "rooms-000005"
    np.testing.assert_array_equal(training[4].left, rooms[4].left)
    np.testing.assert_array_equal(training[6].left, collages[0].left)
    assert (training[5].camera, training[6].camera) == (CAMERA, None)
    assert training.weights == (3.0, 1.0)


def test_the_sets_in_one_folder_share_its_weight_by_their_pairs(rendered, tmp_path):
    training, _ = open_sources(mixed(rendered, collage=0.5, rooms=0.2, scenes=0.3), tmp_path)
    assert [one.count for one in training.sets] == [RECIPE.pairs, 6, 4, 2]
    assert training.sets[2].name(0) == "crane-000000"
    assert training.weights == pytest.approx((0.5, 0.2, 0.2, 0.1))


def test_rendered_pairs_of_a_mix_always_get_the_same_camera_imperfections(rendered, tmp_path):
    training, _ = open_sources(mixed(rendered, rooms=1.0), tmp_path)
    ideal = Shards(rendered / "rooms")
    np.testing.assert_array_equal(training[2].disparity_px, ideal[2].disparity_px)
    for index in range(ideal.count):
        np.testing.assert_array_equal(training[index].right, training[index].right)
    changed = [not np.array_equal(training[i].left, ideal[i].left) for i in range(ideal.count)]
    # A quarter of all pairs have no photometric difference.
    assert sum(changed) >= 3


def test_the_collages_of_a_mix_are_made_like_those_of_other_recipes(rendered, tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(the_pairs.CachedPairs, "make", lambda pairs, _: iter(made.append(pairs.folder) or []))
    training, _ = open_sources(mixed(rendered, rooms=1.0, collage=1.0), tmp_path)
    assert cache_pairs(training, Console(quiet=True)) is training
    assert made == [CachedPairs(tmp_path, RECIPE.seed, RECIPE.pairs, PAIR_SIZE).folder]


def test_a_mix_without_collages_makes_no_training_collages(rendered, tmp_path):
    training, _ = open_sources(mixed(rendered, rooms=1.0), tmp_path)
    cache_pairs(training, Console(quiet=True))
    assert list(tmp_path.iterdir()) == []


def test_the_error_for_a_missing_set_of_a_mix_names_it(rendered, tmp_path):
    assert complaint(open_sources, mixed(rendered, caves=1.0), tmp_path) == (
        f"tiny: mix: {rendered}/caves: expected pairs made by `stereoweave synth make` or folders of such "
        "pairs, found none; render them first"
    )


def test_the_error_for_a_set_smaller_than_the_crop_names_it(rendered, tmp_path):
    recipe = replace(mixed(rendered, scenes=1.0), pair_size=(80, 96), crop_size=(80, 96))
    assert complaint(open_sources, recipe, tmp_path) == (
        f"tiny: crop_size = [80, 96], expected at most [64, 96], the size of the pairs in {rendered}/scenes/"
        "crane; use a smaller crop"
    )


def test_fresh_collages_depend_on_the_seed_and_are_not_cached(tmp_path):
    recipe = replace(RECIPE, fresh=True, pair_size=(32, 48), crop_size=(32, 32))
    training, held_out = open_sources(recipe, tmp_path)
    expected = paint_training_collage(recipe.seed, 0, 5, 32, 48)
    np.testing.assert_array_equal(training[5].left, expected.left)
    np.testing.assert_array_equal(training[5].disparity_px, expected.disparity_px)
    assert training.name(5) == f"collage 5 of seed {recipe.seed}"
    assert [Batches(recipe, training).list_pairs(step) for step in (0, 7)] == [[0, 1], [14, 15]]
    assert held_out.folder.name.startswith(f"seed{VALIDATION_SEED}-")
    assert list(tmp_path.iterdir()) == []


def test_held_out_sets_are_read_from_their_folders(rendered):
    held_out = open_held_out_sets(
        replace(RECIPE, held_out=(("rooms", str(rendered / "rooms")), ("all", str(rendered / "scenes"))))
    )
    assert {name: pairs.count for name, pairs in held_out.items()} == {"rooms": 6, "all": 6}


def test_the_error_for_a_missing_held_out_set_names_it(tmp_path):
    message = complaint(open_held_out_sets, replace(RECIPE, held_out=(("rooms", str(tmp_path / "rooms")),)))
    assert message.startswith(
        f"tiny: held_out: {tmp_path / 'rooms'}: expected pairs made by `stereoweave synth"
    )
