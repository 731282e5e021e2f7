import csv
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from cosmic_ray.mutating import mutate_code

from mutate.drawing import draw, places
from mutate.operators import OUR_OWN

pytestmark = pytest.mark.system

ROOT = Path(__file__).parent.parent
SOURCE = """
def clipped(x, most):
    return min(x, most)


def next_of(x):
    return x + 5
"""
TEST = """
from stereoweave.rendering.renderer import clipped, next_of


def test_large_values_are_clipped():
    assert clipped(7, 3) == 3
    assert clipped(2, 3) == 2


def test_the_next_one_is_greater():
    assert next_of(1) > 1
"""


@pytest.fixture
def repository(tmp_path):
    """Return a repository of two functions, one with a strict test and one with a weak test."""
    root = tmp_path / "repository"
    shutil.copytree(ROOT / "mutate", root / "mutate", ignore=shutil.ignore_patterns("__pycache__"))
    files = {"stereoweave/rendering/renderer.py": SOURCE, "tests/rendering/test_renderer.py": TEST}
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True)
        (root / name).write_text(text)
    (root / "results").mkdir()
    (root / "pyproject.toml").write_text("")
    (root / ".gitignore").write_text("runs/\n__pycache__/\n")
    git = ["git", "-C", str(root), "-c", "user.name=x", "-c", "user.email=x"]
    for words in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "x"]):
        subprocess.run([*git, *words], check=True)
    return root


def mutate(root: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "mutate", "--count", "3", "--jobs", "1"],
        cwd=root,
        env=os.environ | {"PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
    )


def test_a_mutant_that_no_test_detects_survives_and_a_second_run_repeats_no_trial(repository):
    assert {mutant.line for mutant in draw(repository, 3, seed=1)} == {3, 7}
    ended = mutate(repository)
    assert ended.stderr == ""
    assert "killed: stereoweave/rendering/renderer.py:3 SwapFunction" in ended.stdout
    with (repository / "results" / "mutants.csv").open() as table:
        rows = {row["module"]: row for row in csv.DictReader(table)}
    of_all = rows["all"]
    assert (of_all["drawn"], of_all["timeouts"]) == ("3", "0")
    assert 1 <= int(of_all["survived"]) == 3 - int(of_all["killed"])
    assert ended.returncode == 1
    survivors = (repository / "runs" / "mutate" / "survivors-1.diff").read_text()
    assert "-    return x + 5\n+    return x + 6\n" in survivors
    assert "min" not in survivors

    logs = sorted((repository / "runs" / "mutate").glob("*/log-*.txt"))
    before = [log.stat().st_mtime_ns for log in logs]
    again = mutate(repository)
    assert again.stdout.splitlines()[-3:] == ended.stdout.splitlines()[-3:]
    assert [log.stat().st_mtime_ns for log in logs] == before


@pytest.mark.parametrize("operator", OUR_OWN)
def test_every_operator_agrees_with_its_examples(operator):
    for example in operator.examples():
        changed = mutate_code(example.pre_mutation_code, operator(), example.occurrence)
        assert changed == example.post_mutation_code


def test_annotations_texts_and_joined_paths_are_not_mutated(tmp_path):
    source = tmp_path / "source.py"
    source.write_text(
        "def f(*, x: int | None = 1) -> list[1]:\n"
        "    y: A[2] = x * 3\n"
        "    if y < 4:\n"
        "        raise ValueError(f'{y + 5}: expected {x - 6}')\n"
        "    return folder / 'name' / f'{7}'\n"
    )
    assert sorted(places(source)) == [(1, 25), (2, 16), (2, 18), (3, 7), (3, 9), (3, 11)]


def test_a_lower_count_draws_a_prefix_and_another_seed_draws_other_mutants(repository):
    three, four = draw(repository, 3, seed=1), draw(repository, 4, seed=1)
    assert four[:3] == three
    assert draw(repository, 4, seed=2) != four
