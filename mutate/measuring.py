"""Pytest plugin that records the covered lines, the duration and the result of each test.

The variable COVERAGE_PROCESS_START starts coverage, even in the processes that tests start. In those, the
context is the test that pytest names in PYTEST_CURRENT_TEST.
"""

import json
import os
import time
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
from coverage import Coverage

TIMES_FILE = "STEREOWEAVE_MUTATE_TIMES"

# Set-up times of fixtures: first those set up for each test, then those that tests share.
_own_fixture_s: dict[str, float] = {}
_shared_fixture_s: dict[str, float] = {}
_fixtures: dict[str, list[str]] = {}
_call_s: dict[str, float] = {}
_failed: set[str] = set()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, Any, Any]:
    """Attribute all lines that run during a test, including set-up and tear-down, to that test."""
    coverage = Coverage.current()
    assert coverage is not None
    coverage.switch_context(item.nodeid)
    _fixtures[item.nodeid] = list(getattr(item, "fixturenames", ()))
    try:
        return (yield)
    finally:
        coverage.switch_context("")


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: pytest.FixtureDef[Any]) -> Generator[None, Any, Any]:
    """Record the set-up time of a fixture."""
    start_s = time.perf_counter()
    try:
        return (yield)
    finally:
        taken_s = time.perf_counter() - start_s
        seconds = _own_fixture_s if fixturedef.scope == "function" else _shared_fixture_s
        seconds[fixturedef.argname] = max(taken_s, seconds.get(fixturedef.argname, 0))


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Record the time of the test itself, and whether the test, its set-up or its tear-down fails."""
    if report.when == "call":
        _call_s[report.nodeid] = report.duration
    if not report.passed:
        _failed.add(report.nodeid)


def pytest_sessionfinish() -> None:
    """Write the times of all passed tests and of their shared fixtures, and the names of all failed tests."""
    passed = _call_s.keys() - _failed
    taken_s = {
        test: _call_s[test] + sum(_own_fixture_s.get(name, 0) for name in _fixtures[test]) for test in passed
    }
    shared_s = {
        test: {name: _shared_fixture_s[name] for name in _fixtures[test] if name in _shared_fixture_s}
        for test in passed
    }
    text = json.dumps({"taken_s": taken_s, "shared_s": shared_s, "failed": sorted(_failed)})
    Path(os.environ[TIMES_FILE]).write_text(text, encoding="utf-8")
