from dataclasses import replace

import numpy as np
import pytest
from dataset_examples import shades, write_map, write_picture
from learn_examples import PAIR_SIZE, RECIPE, complaint

from stereoweave.learn.pairs import KeptPairs
from stereoweave.learn.sources import VALIDATION_SEED, Source, sources

CALIBRATION = "cam0=[300 0 19.5; 0 300 15.5; 0 0 1]\ndoffs=0\nbaseline=100\nwidth=40\nheight=32\n"
FRAMES = [f"mill/{number:04d}" for number in range(40)]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Forty frames in the paper's layout, 5 m away; the left picture of each tells its number."""
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


def names(source):
    return [source.name(index) for index in range(source.count)]


def test_collages_are_kept_apart_from_those_for_validation(tmp_path):
    training, held_out = sources(RECIPE, tmp_path)
    assert training.folder == KeptPairs(tmp_path, RECIPE.seed, 4, PAIR_SIZE).folder
    assert held_out.folder == KeptPairs(tmp_path, VALIDATION_SEED, 2, PAIR_SIZE).folder
    assert training.folder != held_out.folder
    assert (training.count, held_out.count) == (4, 2)
    assert isinstance(training, Source)


def test_each_frame_of_a_dataset_is_trained_on_or_held_out(recipe, tmp_path):
    training, held_out = sources(recipe, tmp_path)
    assert isinstance(training, Source)
    # The end of the sequence, a tenth of it.
    assert names(training) == FRAMES[:36]
    assert names(held_out) == FRAMES[36:]
    assert list(tmp_path.iterdir()) == []


def test_the_split_is_the_recipe_s(recipe, tmp_path):
    training, held_out = sources(replace(recipe, split="random"), tmp_path)
    assert sorted(names(training) + names(held_out)) == FRAMES
    assert names(held_out) != FRAMES[36:]


def test_a_frame_is_read_when_it_is_asked_for(recipe, tmp_path):
    training, _ = sources(recipe, tmp_path)
    sample = training[7]
    assert shades(sample) == (7, 100)
    # f B = 30 px m, 5 m away.
    np.testing.assert_allclose(sample.disparity_px[0, :2], [np.nan, 6])
    assert sample.camera.focal_px == 300


@pytest.mark.parametrize(
    ("count", "chosen"), [(1, [36]), (2, [36, 39]), (3, [36, 38, 39]), (4, [36, 37, 38, 39])]
)
def test_validation_pairs_are_spread_over_the_held_out_frames(recipe, tmp_path, count, chosen):
    _, held_out = sources(replace(recipe, validation_pairs=count), tmp_path)
    assert names(held_out) == [FRAMES[number] for number in chosen]


def test_all_held_out_frames_are_given_where_all_are_asked_for(recipe, tmp_path):
    _, held_out = sources(replace(recipe, validation_pairs=1), tmp_path, whole=True)
    assert names(held_out) == FRAMES[36:]


def test_an_unknown_dataset_is_answered_with_the_known_ones(recipe, tmp_path):
    message = complaint(sources, replace(recipe, dataset="propeller"), tmp_path)
    assert message.startswith("tiny: dataset = 'propeller', expected collage or sintel, flyingthings3d, ")


def test_a_root_that_lacks_a_folder_is_named(recipe, tmp_path):
    assert str(tmp_path / "nowhere") in complaint(
        sources, replace(recipe, root=str(tmp_path / "nowhere")), tmp_path
    )
