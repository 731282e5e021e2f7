import os

import numpy as np
import pytest

from stereoweave.synth import kept_textures, patterns, textures
from stereoweave.synth.kept_textures import kept

SHAPE = (2, 8, 8, 4)
MONTH_S = 31 * 24 * 60 * 60


class Bank:
    """A small bank as a new process finds it, whose source says `version`; `drawn` counts how often it is."""

    def __init__(self, tmp_path, texels):
        self.folder, self.source = tmp_path / "textures", tmp_path / "a.py"
        self.texels, self.drawn = texels, 0
        self.source.write_text("first")

    def __call__(self, version="first"):
        self.source.write_text(version)
        return kept("rgba", [self.source], SHAPE, self.draw)

    def draw(self):
        self.drawn += 1
        return self.texels


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr(kept_textures, "cache_folder", lambda: tmp_path / "kernels")


@pytest.fixture
def bank(cache, tmp_path, rng):
    return Bank(tmp_path, rng.integers(0, 256, SHAPE, np.uint8))


def test_a_kept_bank_is_read_and_not_drawn_again(bank):
    bank()
    assert [file.suffix for file in bank.folder.iterdir()] == [".rgba"]
    np.testing.assert_array_equal(bank(), bank.texels)
    assert bank.drawn == 1


@pytest.mark.parametrize(
    "damage",
    [
        lambda kept: b"",
        lambda kept: bytes(4),
        lambda kept: kept[: len(kept) // 2],
        lambda kept: kept + b"more",
        lambda kept: kept[:100] + bytes([kept[100] ^ 1]) + kept[101:],
    ],
    ids=["empty", "four zeros", "cut", "grown", "one bit"],
)
def test_a_damaged_file_is_made_anew(bank, damage):
    bank()
    (file,) = bank.folder.iterdir()
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    np.testing.assert_array_equal(bank(), bank.texels)
    assert bank.drawn == 2
    assert file.read_bytes() == whole


def test_a_bank_of_other_code_is_drawn_anew_and_banks_of_last_month_are_removed(bank):
    kept_before = set()
    for version, age_s in [("oldest", 2 * MONTH_S), ("old", 0), ("new", 0)]:
        bank(version)
        (made,) = set(bank.folder.iterdir()) - kept_before
        kept_before = set(bank.folder.iterdir())
        os.utime(made, (made.stat().st_mtime - age_s,) * 2)
    assert bank.drawn == 3
    assert len(kept_before) == 2
    bank("old"), bank("new")
    assert bank.drawn == 3


def test_where_nothing_can_be_kept_the_bank_is_there_all_the_same(bank):
    bank.folder.write_text("a file where the folder should be")
    for _ in range(2):
        np.testing.assert_array_equal(bank(), bank.texels)
    assert bank.drawn == 2


def test_the_patterns_are_those_that_are_drawn_whether_they_were_kept_or_not(cache, tmp_path, monkeypatch):
    for name, count in {"PHOTOGRAPH_CROPS": 3, "NATURAL_PROCEDURAL": 2, "PERIODIC_PROCEDURAL": 1}.items():
        monkeypatch.setattr(patterns, name, count)
    drawn = patterns.bank.__wrapped__()
    assert len(list((tmp_path / "textures").glob("*.rgb"))) == 1
    monkeypatch.setattr(patterns, "_drawn", lambda: pytest.fail("drawn again"))
    for bank in (drawn, patterns.bank.__wrapped__()):
        assert (len(bank.natural), len(bank.periodic), len(bank.lights)) == (5, 1, patterns.LIGHT_MAPS)
        np.testing.assert_array_equal(bank.natural[4], patterns.procedural(patterns.NATURAL, 1))
        np.testing.assert_array_equal(bank.periodic[0], patterns.procedural(patterns.PERIODIC, 0))


def test_the_textures_of_scenes_are_kept_too(cache, tmp_path, monkeypatch):
    monkeypatch.setattr(textures, "FAMILIES", {"plain": textures.FAMILIES["plain"]})
    drawn = textures.bank.__wrapped__().pixels
    assert len(list((tmp_path / "textures").glob("*.rgba"))) == 1
    np.testing.assert_array_equal(textures.bank.__wrapped__().pixels, drawn)
    np.testing.assert_array_equal(drawn[1], textures.texture("plain", 1))
