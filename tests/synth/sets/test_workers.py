import io
import os
import time

import pytest
from rich.console import Console

from stereoweave.synth.sets.workers import run_in_workers


def test_of_several_errors_of_a_worker_the_first_is_raised(tmp_path):
    missing = [tmp_path / f"missing{number}" for number in range(20)]
    answers = run_in_workers(
        os.listdir, [tmp_path, *missing], 1, Console(file=io.StringIO()), "listing", len(missing) + 1
    )
    assert next(answers) == []
    time.sleep(0.5)  # until all other tasks have failed
    with pytest.raises(FileNotFoundError, match="missing0"):
        next(answers)
