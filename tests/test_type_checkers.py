"""Type checkers know exactly the names that the package has, and what its functions take."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import TypeCheckError

import stereoweave as sw
from stereoweave.io.colormap import colour_disparity

REPOSITORY = Path(__file__).resolve().parent.parent
# The line numbers of the errors are the keys.
WRONG = {
    3: "sw.nonsense",
    4: "sw.estimates('left.png', 'right.png')",
    5: "sw.estimate(5, 'right.png')",
    6: "sw.estimate('left.png', 'right.png').disparity",
}


@pytest.fixture(scope="module")
def complaints(tmp_path_factory) -> dict[int, str]:
    """Return mypy's errors by line for a user's program: first the wrong lines, then every public name."""
    folder = tmp_path_factory.mktemp("program")
    lines = ["import stereoweave as sw", "", *WRONG.values(), *(f"sw.{name}" for name in sw.__all__)]
    (folder / "program.py").write_text("\n".join([*lines, "sw.estimate('left.png', 'right.png')\n"]))
    options = ["--config-file=", "--strict", "--follow-imports=silent", f"--cache-dir={folder / 'cache'}"]
    command = [sys.executable, "-m", "mypy", *options, folder / "program.py"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    found = re.findall(r"program\.py:(\d+): error: (.*)", done.stdout)
    return {int(line): text for line, text in found}


def test_a_name_that_does_not_exist_is_an_error(complaints):
    assert 'Module has no attribute "nonsense"' in complaints[3]
    assert 'Module has no attribute "estimates"' in complaints[4]
    with pytest.raises(AttributeError, match="nonsense"):
        sw.nonsense  # type: ignore[attr-defined]  # noqa: B018


def test_an_argument_that_is_no_image_is_an_error(complaints):
    assert 'Argument 1 to "estimate" has incompatible type "int"' in complaints[5]


def test_results_have_types(complaints):
    assert '"Estimate" has no attribute "disparity"' in complaints[6]


def test_every_public_name_is_known(complaints):
    assert complaints.keys() == WRONG.keys()


@pytest.mark.parametrize(("shape", "range_px"), [((3,), (0.0, 1.0)), ((2, 2), "far")])
def test_within_the_tests_shapes_and_types_of_arguments_are_checked(shape, range_px):
    for _ in range(2):  # the first call builds the check
        with pytest.raises(TypeCheckError):
            colour_disparity(np.zeros(shape, np.float32), range_px)
