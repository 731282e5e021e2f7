"""The index of the trained networks in checkpoints/ is complete and correct."""

import hashlib
import tomllib
from pathlib import Path

import pytest

from stereoweave.learn import checkpoint

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "checkpoints"
INDEX = tomllib.loads((FOLDER / "INDEX.toml").read_text(encoding="utf-8"))


def test_each_checkpoint_is_listed_once():
    listed = sorted(entry["file"] for entry in INDEX.values())
    assert listed == sorted(file.name for file in FOLDER.iterdir() if file.name != "INDEX.toml")


def test_each_checksum_is_that_of_the_file():
    for entry in INDEX.values():
        assert entry["sha256"] == hashlib.sha256((FOLDER / entry["file"]).read_bytes()).hexdigest()


@pytest.mark.parametrize("name", INDEX)
def test_the_index_agrees_with_the_checkpoint_about_its_training(name):
    entry, kept = INDEX[name], checkpoint.load(FOLDER / INDEX[name]["file"])
    assert (entry["commit"], entry["steps"]) == (kept.commit, kept.step)
    assert (tomllib.loads((ROOT / entry["recipe"]).read_text())["name"]) == kept.recipe.name
    assert entry["scores"] == {key: pytest.approx(kept.scores[key], rel=1e-3) for key in entry["scores"]}


@pytest.mark.parametrize("name", INDEX)
def test_something_uses_each_checkpoint(name):
    users = INDEX[name]["used_by"]
    assert users
    assert [user for user in users if not (ROOT / user).exists()] == []


def test_a_recipe_starts_from_a_checkpoint_that_is_listed_or_from_a_run():
    listed = {f"checkpoints/{entry['file']}" for entry in INDEX.values()}
    starts = {
        tomllib.loads(file.read_text()).get("start_from", "") for file in ROOT.glob("recipes/**/*.toml")
    }
    assert {start for start in starts if start and not start.startswith("runs/")} <= listed
