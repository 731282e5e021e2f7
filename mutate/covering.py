"""Which tests cover a line, and which of them are asked about a mutant there."""

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

# What a mutant's tests may take together, the quicker ones first, without what they share: that is often
# worth its time.
_MOST_S = 60
# Tests of one such class of time run file by file, because leaving a file ends what its tests share.
_CLASSES_S = [1, 5]


@dataclass(frozen=True)
class Covered:
    """What was measured of the unchanged sources.

    Attributes:
        taken_s: The seconds that each test takes, without what it shares with others; of those that passed.
        shared_s: The seconds that each fixture takes that a test shares with others, by test.
        tests: The tests that run a line, by source and line.
        failed: Tests that failed without any change.
    """

    taken_s: dict[str, float]
    shared_s: dict[str, dict[str, float]]
    tests: dict[str, dict[int, set[str]]]
    failed: list[str]

    def choose(self, mutant: Mutant, root: Path) -> list[str]:
        """The tests that are asked about a mutant, in order: the quick ones first, about a minute of them."""
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
        """How long tests take together."""
        shared_s = {name: seconds for test in tests for name, seconds in self.shared_s[test].items()}
        return sum(shared_s.values()) + sum(self.taken_s[test] for test in tests)

    def _turn(self, test: str) -> tuple[int, str]:
        return bisect(_CLASSES_S, self.seconds([test])), test.partition("::")[0]

    def _covering(self, mutant: Mutant) -> set[str]:
        of_line = self.tests.get(mutant.path, {})
        lines = _lines_of_statement(ast.parse(mutant.before), mutant.line)
        return {test for line in lines or of_line for test in of_line.get(line, ())} & self.taken_s.keys()


def _lines_of_statement(tree: ast.Module, line: int) -> Iterable[int]:
    """The lines of the statement that has this line, or of its head; none outside of functions.

    What is run by an import counts as covered by all tests of the source.
    """
    inside, lines = False, range(0)
    for node in ast.walk(tree):  # from the outside to the inside
        if isinstance(node, ast.stmt) and node.lineno <= line <= (node.end_lineno or 0):
            body = getattr(node, "body", None)
            end = body[0].lineno if body else (node.end_lineno or 0) + 1
            lines = range(node.lineno, max(end, node.lineno + 1))
            inside |= isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and line not in lines
    return lines if inside else ()


def lines_run(folder: Path, tree: Path) -> dict[str, dict[int, list[str]]]:
    """The tests that ran a line, by source and line, from the data of coverage that all processes left."""
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
    # A process that a test started has "tests/test_x.py::test_y (call)", as pytest writes it there.
    return context.rpartition(" (")[0] if context.endswith(("(setup)", "(call)", "(teardown)")) else context


def read_covered(paths: Iterable[Path]) -> Covered:
    """What was measured of all test files, from a JSON file of each."""
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
