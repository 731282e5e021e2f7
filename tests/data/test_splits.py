from itertools import product

import numpy as np
import pytest
from dataset_examples import error_of

from stereoweave.data.frames import Frame
from stereoweave.data.readers import DATASETS
from stereoweave.data.splits import SPLITS, split_frames


def frames(*names):
    return [Frame(name=name, read=lambda: pytest.fail("a split reads nothing")) for name in names]


def run(sequence, count):
    return [f"{sequence}/{i:04d}" for i in range(count)]


def names(parts):
    return [[frame.name for frame in part] for part in parts]


def passes(*sequences):
    return frames(*(f"{kind}/{name}" for kind in ("clean", "final") for name in sequences))


EXAMPLES = {
    "sintel": passes(*run("alley_1", 9), *run("temple_2", 3), *run("temple_3", 2), *run("temple", 2)),
    "flyingthings3d": passes(*run("TRAIN/A/0000", 8), *run("TEST/A/0000", 2)),
    "driving": passes(*run("15mm/fast", 30), *run("35mm/slow", 80)),
    "monkaa": passes(*run("family_x2", 9), *run("treeflight_x2", 3), *run("treeflight_augmented0_x2", 2)),
    "kitti2012": frames(*(f"{i:06d}_10" for i in range(194))),
    "kitti2015": frames(*(f"{i:06d}_10" for i in range(200))),
    "middlebury2001": frames("map", "tsukuba", "venus"),
    "middlebury2003": frames("cones", "teddy"),
    "middlebury2005": frames("Art", "Reindeer/Illum1/Exp0"),
    "middlebury2006": frames("Aloe", "Midd1", "Midd2", "Monopoly"),
    "middlebury2014": frames("Motorcycle-imperfect", "Motorcycle-perfect", "Piano-perfect", "Pipes-perfect"),
    "middlebury2021": frames("artroom1", "traproom1", "traproom2"),
    "eth3d": frames("delivery_area_1l", "facade_1s", "forest_1s", "forest_2s"),
    "paper": frames(*run("mill", 20), *run("propeller", 40)),
    "paper_worlds": frames(*(name for world in range(5) for name in run(f"propeller/{world:03d}", 6))),
    "shards": frames(*(f"ship/ship-{i:06d}" for i in range(30)), *(f"ship-{i:06d}" for i in range(10))),
}

CASES = list(product(DATASETS, SPLITS))


def test_there_is_an_example_of_every_dataset():
    assert list(EXAMPLES) == list(DATASETS)


@pytest.mark.parametrize(("dataset", "split"), CASES)
def test_every_dataset_has_every_split_and_each_frame_is_in_one_part(dataset, split):
    training, held_out = names(split_frames(EXAMPLES[dataset], dataset, split))
    assert training and held_out
    assert training == sorted(training)
    assert held_out == sorted(held_out)
    assert sorted(training + held_out) == sorted(frame.name for frame in EXAMPLES[dataset])


@pytest.mark.parametrize(("dataset", "split"), CASES)
def test_a_split_depends_on_the_names_alone(dataset, split):
    forwards = split_frames(EXAMPLES[dataset], dataset, split)
    assert names(split_frames(EXAMPLES[dataset][::-1], dataset, split)) == names(forwards)


@pytest.mark.parametrize("dataset", DATASETS)
def test_a_random_split_holds_out_a_tenth(dataset):
    training, held_out = split_frames(frames(*run("a", 200)), dataset, "random")
    assert (len(training), len(held_out)) == (180, 20)


def test_a_random_split_is_the_beginning_of_a_seeded_permutation():
    ten = run("a", 10)
    first = np.random.default_rng(0).permutation(10)[0]
    assert names(split_frames(frames(*ten), "sintel", "random"))[1] == [ten[first]]


def test_sintel_s_held_out_place_is_held_out_in_both_passes():
    _, held_out = names(split_frames(EXAMPLES["sintel"], "sintel", "disjoint"))
    sequences = [f"{kind}/{name}" for kind in ("clean", "final") for name in ("temple_2", "temple_3")]
    assert sorted({name.rpartition("/")[0] for name in held_out}) == sequences
    assert len(held_out) == 2 * (3 + 2)


def test_flyingthings3d_is_split_as_published():
    _, held_out = names(split_frames(EXAMPLES["flyingthings3d"], "flyingthings3d", "disjoint"))
    assert held_out == [f"{kind}/TEST/A/0000/{i}" for kind in ("clean", "final") for i in ("0000", "0001")]


def test_driving_loses_the_last_tenth_of_every_run():
    _, held_out = names(split_frames(EXAMPLES["driving"], "driving", "disjoint"))
    last = [f"15mm/fast/{i:04d}" for i in range(27, 30)] + [f"35mm/slow/{i:04d}" for i in range(72, 80)]
    assert held_out == [f"{kind}/{name}" for kind in ("clean", "final") for name in last]


def test_monkaa_loses_a_scene_with_all_its_augmentations():
    training, held_out = names(split_frames(EXAMPLES["monkaa"], "monkaa", "disjoint"))
    assert {name.split("/")[1] for name in held_out} == {"treeflight_x2", "treeflight_augmented0_x2"}
    assert {name.split("/")[1] for name in training} == {"family_x2"}


@pytest.mark.parametrize(("dataset", "count"), [("kitti2012", 19), ("kitti2015", 20)])
def test_kitti_is_cut_once(dataset, count):
    training, held_out = names(split_frames(EXAMPLES[dataset], dataset, "disjoint"))
    assert len(held_out) == count
    assert training[-1] < held_out[0]


@pytest.mark.parametrize(
    ("dataset", "expected"),
    [
        ("middlebury2001", ["venus"]),
        ("middlebury2003", ["teddy"]),
        ("middlebury2005", ["Reindeer/Illum1/Exp0"]),
        ("middlebury2006", ["Midd1", "Midd2"]),
        ("middlebury2014", ["Motorcycle-imperfect", "Motorcycle-perfect", "Pipes-perfect"]),
        ("middlebury2021", ["traproom1", "traproom2"]),
        ("eth3d", ["facade_1s", "forest_1s", "forest_2s"]),
    ],
)
def test_scenes_are_held_out_whole(dataset, expected):
    assert names(split_frames(EXAMPLES[dataset], dataset, "disjoint"))[1] == expected


def test_the_paper_s_scenes_lose_their_ends():
    _, held_out = names(split_frames(EXAMPLES["paper"], "paper", "disjoint"))
    assert held_out == ["mill/0018", "mill/0019", *(f"propeller/{i:04d}" for i in range(36, 40))]


def test_worlds_are_held_out_whole():
    training, held_out = names(split_frames(EXAMPLES["paper_worlds"], "paper_worlds", "disjoint"))
    assert held_out == run("propeller/004", 6)
    assert len(training) == 4 * 6


def test_every_scene_loses_the_last_fifth_of_its_worlds_and_at_least_one():
    worlds = [
        f"{scene}/{number:03d}" for scene, count in (("pylon", 10), ("ship", 2)) for number in range(count)
    ]
    made = frames(*(name for world in worlds for name in run(world, 3)))
    _, held_out = split_frames(made, "paper_worlds", "disjoint")
    assert list(dict.fromkeys(frame.sequence for frame in held_out)) == ["pylon/008", "pylon/009", "ship/001"]


def test_an_unknown_split_or_dataset_is_an_error_that_names_the_known_ones():
    assert "random, disjoint, found 'even'" in error_of(split_frames, EXAMPLES["paper"], "paper", "even")
    assert "sintel, flyingthings3d" in error_of(split_frames, EXAMPLES["paper"], "propeller", "random")


@pytest.mark.parametrize(
    ("given", "found"), [([], "0 and 0"), (["clean/temple_2/1"], "0 and 1"), (["clean/alley_1/1"], "1 and 0")]
)
def test_a_split_with_an_empty_part_is_an_error(given, found):
    assert f"found {found}" in error_of(split_frames, frames(*given), "sintel", "disjoint")


def test_a_single_frame_cannot_be_split():
    assert "found 0 and 1" in error_of(split_frames, frames("a/1"), "paper", "disjoint")
