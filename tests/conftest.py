"""What the tests share, and which of them need something that a bare machine does not have.

A marker of `CAPABILITIES` on a test says what it needs. Where that is missing the test is left out, and the
summary says so; with STEREOWEAVE_REQUIRE_ALL=1 the run fails instead.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jaxtyping
import numpy as np
import pytest

TESTDATA = Path(
    os.environ.get("STEREOWEAVE_TESTDATA") or Path(__file__).resolve().parent.parent.parent / "shared"
)


class Capability(NamedTuple):
    present: bool
    tests: str
    missing: str


def renders() -> bool:
    """Whether OpenGL works without a window; tried in a process of its own, which a broken driver may end."""
    program = "import moderngl; moderngl.create_context(standalone=True, backend='egl')"
    return subprocess.run([sys.executable, "-c", program], capture_output=True, check=False).returncode == 0


CAPABILITIES = {
    "testdata": Capability(
        (TESTDATA / "stereo").is_dir(), "on the real pictures", f"STEREOWEAVE_TESTDATA={TESTDATA} not found"
    ),
    "needs_chromium": Capability(
        shutil.which("chromium") is not None, "in a browser", "no chromium on the PATH"
    ),
    "needs_egl": Capability(renders(), "of the renderer", "no EGL: apt install libegl1 libgl1-mesa-dri"),
}

LEFT_OUT = pytest.StashKey[dict[str, int]]()


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    missing = [name for name, capability in CAPABILITIES.items() if not capability.present]
    left_out = [item for item in items if any(item.get_closest_marker(name) for name in missing)]
    config.stash[LEFT_OUT] = {
        name: sum(item.get_closest_marker(name) is not None for item in left_out) for name in missing
    }
    if left_out and os.environ.get("STEREOWEAVE_REQUIRE_ALL") == "1":
        raise pytest.UsageError("; ".join(_left_out_lines(config)) + "; STEREOWEAVE_REQUIRE_ALL=1 forbids it")
    items[:] = [item for item in items if item not in left_out]
    config.hook.pytest_deselected(items=left_out)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    for line in _left_out_lines(config):
        terminalreporter.write_line(line, yellow=True)


def _left_out_lines(config: pytest.Config) -> Iterator[str]:
    for name, count in config.stash.get(LEFT_OUT, {}).items():
        if count:
            yield f"left out: {count} tests {CAPABILITIES[name].tests}: {CAPABILITIES[name].missing}"


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def testdata() -> Path:
    """The folder of real pictures and of the referee, for tests that carry the marker `testdata`."""
    return TESTDATA


@pytest.fixture
def without_shape_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    """As users run the package, for tests of the errors that users see where jaxtyping would speak first."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
