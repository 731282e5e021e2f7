"""Line coverage of each test, and selection of the tests for a mutant."""

import ast
import json
from bisect import bisect
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

from coverage import CoverageData

from mutate.drawing import Mutant
from mutate.targets import TARGETS

# Limit on the total time of the tests of a mutant, fastest first. Shared fixtures do not count, because many
# tests need them.
_MOST_S = 60
# Upper limits of the time classes. Within a class, tests run file by file, because leaving a file ends its
# shared fixtures.
_CLASSES_S = [1, 5]


@dataclass(frozen=True)
class Covered:
    """Measurements of the tests on the unchanged sources.

    Attributes:
        taken_s: Duration of each passed test, without shared fixtures.
        shared_s: Durations of the shared fixtures of each test, by test and fixture.
        tests: Tests that run each line, by source and line.
        failed: Tests that failed on the unchanged sources.
    """

    taken_s: dict[str, float]
    shared_s: dict[str, dict[str, float]]
    tests: dict[str, dict[int, set[str]]]
    failed: list[str]

    def choose(self, mutant: Mutant, root: Path) -> list[str]:
        """Return the tests for a mutant, fast ones first, for up to a minute of test time."""
        found = self._covering(mutant)
        target = TARGETS[mutant.target]
        if target.elsewhere or not found:
            own = tuple(f"{file}::" for file in target.own_test_files(root))
            found |= {test for test in self.taken_s if test.startswith(own)}
        quickest = sorted(found, key=lambda test: (self.taken_s[test], test))
        total_s = accumulate(self.taken_s[test] for test in quickest)
        chosen = [test for test, seconds in zip(quickest, total_s, strict=True) if seconds <= _MOST_S]
        return sorted(chosen or quickest[:1], key=self._turn)

    def seconds(self, tests: Sequence[str]) -> float:
        """Return the total duration of tests in seconds, with each shared fixture counted once."""
        shared_s = {name: seconds for test in tests for name, seconds in self.shared_s[test].items()}
        return sum(shared_s.values()) + sum(self.taken_s[test] for test in tests)

    def _turn(self, test: str) -> tuple[int, str]:
        return bisect(_CLASSES_S, self.seconds([test])), test.partition("::")[0]

    def _covering(self, mutant: Mutant) -> set[str]:
        of_line = self.tests.get(mutant.path, {})
        lines = _lines_of_statement(ast.parse(mutant.before), mutant.line)
        return {test for line in lines or of_line for test in of_line.get(line, ())} & self.taken_s.keys()


def _lines_of_statement(tree: ast.Module, line: int) -> Iterable[int]:
    """Return the lines of the statement or statement header that contains a line; none outside functions.

    Code that runs on import counts as covered by all tests of the source.
    """
    inside, lines = False, range(0)
    for node in ast.walk(tree):  # outer statements first
        if isinstance(node, ast.stmt) and node.lineno <= line <= (node.end_lineno or 0):
            body = getattr(node, "body", None)
            end = body[0].lineno if body else (node.end_lineno or 0) + 1
            lines = range(node.lineno, max(end, node.lineno + 1))
            inside |= isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and line not in lines
    return lines if inside else ()


def lines_run(folder: Path, tree: Path) -> dict[str, dict[int, list[str]]]:
    """Return the tests that ran each line, by source and line, from the coverage data of all processes."""
    found: dict[str, dict[int, set[str]]] = defaultdict(lambda: defaultdict(set))
    for path in folder.glob(".coverage.*"):
        data = CoverageData(str(path))
        data.read()
        for source in data.measured_files():
            of_source = found[str(Path(source).relative_to(tree))]
            for line, contexts in data.contexts_by_lineno(source).items():
                of_source[line] |= {_test(context) for context in contexts} - {""}
    return {source: {line: sorted(tests) for line, tests in of.items()} for source, of in found.items()}


def _test(context: str) -> str:
    # In a process that a test started, the context comes from pytest: "tests/test_x.py::test_y (call)".
    return context.rpartition(" (")[0] if context.endswith(("(setup)", "(call)", "(teardown)")) else context


def read_covered(paths: Iterable[Path]) -> Covered:
    """Return the combined measurements of all test files, read from one JSON file each."""
    covered = Covered({}, {}, defaultdict(lambda: defaultdict(set)), [])
    for path in paths:
        measured: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        covered.taken_s.update(measured["taken_s"])
        covered.shared_s.update(measured["shared_s"])
        covered.failed.extend(measured["failed"])
        for source, of_source in measured["lines"].items():
            for line, tests in of_source.items():
                covered.tests[source][int(line)].update(tests)
    return covered
