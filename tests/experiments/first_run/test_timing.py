from pathlib import Path

import pytest

from experiments.first_run import timing
from stereoweave.errors import StereoweaveError

EXAMPLES = Path(__file__).resolve().parents[3] / "examples"


@pytest.fixture(autouse=True)
def a_command_without_kernels(monkeypatch):
    monkeypatch.setattr(timing, "COMMANDS", {"check": []})


def test_the_first_word_comes_before_the_end_and_each_command_is_run_twice():
    first, after = timing.measure_first_runs(EXAMPLES / "left.png", EXAMPLES / "right.png", turns=1)
    assert (first.command, first.run, after.command, after.run) == ("check", "first", "check", "next")
    for row in (first, after):
        assert 0 < row.first_word_s <= row.wall_s
        assert row.processor_s > 0


def test_the_words_of_a_command_that_fails_are_in_the_error(tmp_path):
    with pytest.raises(StereoweaveError, match=r"expected exit code 0, found 2: stereoweave: .*missing\.png"):
        timing.measure_first_runs(tmp_path / "missing.png", EXAMPLES / "right.png", turns=1)
