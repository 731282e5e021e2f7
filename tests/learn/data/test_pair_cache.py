import io
from contextlib import ExitStack

import numpy as np
from learn_examples import PAIR_SIZE, box_before_a_wall, keep_pairs
from rich.console import Console

from stereoweave.io.output_lock import lock_output
from stereoweave.learn.data import pair_cache as pairs_module
from stereoweave.learn.data.collage import paint_collage
from stereoweave.learn.data.pair_cache import CachedPairs

HALF_A_STEP_PX = 1 / 512


def assert_kept(found, made):
    for name in ("left", "right", "occluded", "right_occluded"):
        np.testing.assert_array_equal(getattr(found, name), getattr(made, name), err_msg=name)
    for name in ("disparity_px", "right_disparity_px"):
        assert getattr(found, name).dtype == np.float32
        np.testing.assert_allclose(getattr(found, name), getattr(made, name), rtol=0, atol=HALF_A_STEP_PX)


def test_a_kept_pair_comes_back(tmp_path, rng):
    pairs = keep_pairs(tmp_path, 3, 2)
    made = box_before_a_wall(np.random.default_rng((3, 1)))
    assert_kept(pairs[1], made)


def test_disparities_are_kept_to_half_of_a_256th(tmp_path, rng):
    pairs = keep_pairs(tmp_path, 3, 1)
    values_px = rng.uniform(0, 255.9, (2, *PAIR_SIZE)).astype(np.float32)
    made = box_before_a_wall(rng)
    varied = type(made)(**vars(made) | {"disparity_px": values_px[0], "right_disparity_px": values_px[1]})
    pairs.keep(0, varied)
    assert_kept(pairs[0], varied)


def test_pairs_of_another_seed_or_size_are_kept_apart(tmp_path):
    keep_pairs(tmp_path, 3, 2)
    assert CachedPairs(tmp_path, 3, 2, PAIR_SIZE).missing() == []
    assert CachedPairs(tmp_path, 3, 4, PAIR_SIZE).missing() == [2, 3]
    assert CachedPairs(tmp_path, 4, 2, PAIR_SIZE).missing() == [0, 1]
    assert CachedPairs(tmp_path, 3, 2, (96, 64)).missing() == [0, 1]


def test_pairs_of_another_version_of_the_generator_are_kept_apart(tmp_path, monkeypatch):
    keep_pairs(tmp_path, 3, 2)
    for source in pairs_module._SOURCES:
        (tmp_path / source).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / source).write_text("changed")
    monkeypatch.setattr(pairs_module, "__file__", str(tmp_path / "learn" / "data" / "pair_cache.py"))
    assert CachedPairs(tmp_path, 3, 2, PAIR_SIZE).missing() == [0, 1]


def test_a_training_waits_for_pairs_that_another_one_makes_and_does_not_make_them_again(tmp_path):
    folder = keep_pairs(tmp_path, 3, 1).folder
    other = ExitStack()

    class Screen(io.StringIO):
        def write(self, text: str) -> int:
            keep_pairs(tmp_path, 3, 2)
            other.close()
            return super().write(text)

    screen = Screen()
    with other:
        other.enter_context(lock_output(folder))
        made = list(CachedPairs(tmp_path, 3, 3, PAIR_SIZE).make(Console(file=screen, width=1000)))
    assert made == [2]
    assert screen.getvalue() == f"{folder}: another training is making these pairs; waiting for it\n"


def test_missing_and_half_written_pairs_are_made_again_by_the_generator(tmp_path):
    pairs = keep_pairs(tmp_path, 3, 1)
    kept = next(pairs.folder.iterdir()).read_bytes()
    (pairs.folder / "000001.part").write_bytes(kept[: len(kept) // 2])
    pairs = CachedPairs(tmp_path, 3, 3, PAIR_SIZE)
    assert pairs.missing() == [1, 2]
    assert sorted(pairs.make(Console(quiet=True))) == [1, 2]
    assert pairs.missing() == []
    assert sorted(file.name for file in pairs.folder.iterdir()) == ["000000.npz", "000001.npz", "000002.npz"]
    assert (pairs.folder / "000000.npz").read_bytes() == kept
    for index in (1, 2):
        assert_kept(pairs[index], paint_collage(3, 0, index, *PAIR_SIZE))
