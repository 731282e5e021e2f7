"""Resumable run of the tests on many mutants."""

import hashlib
import json
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import Queue
from typing import Any

from mutate.covering import Covered, lines_run, read_covered
from mutate.drawing import Mutant
from mutate.measuring import TIMES_FILE
from mutate.targets import TARGETS
from mutate.trees import Tree, repository_files

KILLED, SURVIVED, TIMEOUT = "killed", "survived", "timeout"

_MEASURED_WITHIN_S = 900
# Tests on a busy machine take longer than when they were measured.
_TIMES_AS_LONG, _START_S = 4, 60
# Tests that call nearly all Numba kernels.
_COMPILING = ("tests/rendering/test_camera_motion.py", "tests/rendering/test_synthesize.py")
# Exit code of pytest if it collects no tests.
_NO_TESTS = 5
# Only these files can change the result of a test.
_PARTS = ("stereoweave/", "tests/", "examples/", "mutate/", "pyproject.toml")

Report = Callable[[str], None]


@dataclass(frozen=True)
class Trial:
    """Result of trying a mutant: the outcome, the time taken, and the number of selected tests."""

    mutant: Mutant
    outcome: str
    seconds: float
    tests: int


class Session:
    """Run on one state of the sources and tests, with a folder that stores its measurements and outcomes."""

    def __init__(self, root: Path, runs: Path, jobs: int) -> None:
        self.root = root
        self.folder = runs / _digest(root)
        (self.folder / "covered").mkdir(parents=True, exist_ok=True)
        self._trees = [Tree(root, runs / f"tree-{index}") for index in range(jobs)]
        self._free: Queue[Tree] = Queue()
        for tree in self._trees:
            self._free.put(tree)

    def measure(self, report: Report) -> Covered:
        """Return the coverage of all tests; measure the test files that have not been measured yet."""
        files = sorted({file for target in TARGETS.values() for file in target.test_files(self.root)})
        with self._open_pool() as pool:
            if any(not self._measurements_path(file).exists() for file in files):
                report("compiling")
                list(pool.map(self._compile, self._trees))
            return read_covered(pool.map(lambda file: self._measure_file(file, report), files))

    def try_all(self, mutants: Sequence[Mutant], covered: Covered, seed: int) -> Iterator[Trial]:
        """Yield the trials known from an earlier run of this session, then the new ones as they finish."""
        kept = self.folder / f"outcomes-{seed}.jsonl"
        known = _read_outcomes(kept)
        waiting = []
        for turn, mutant in enumerate(mutants):
            if turn in known:
                yield Trial(mutant, **known[turn])
            else:
                waiting.append((turn, mutant))
        with self._open_pool() as pool, kept.open("a", encoding="utf-8") as out:
            trials = {pool.submit(self._try, mutant, covered, turn): turn for turn, mutant in waiting}
            for future in as_completed(trials):
                trial = future.result()
                facts = {"outcome": trial.outcome, "seconds": trial.seconds, "tests": trial.tests}
                out.write(json.dumps({"turn": trials[future]} | facts) + "\n")
                out.flush()
                yield trial

    @contextmanager
    def _open_pool(self) -> Iterator[ThreadPoolExecutor]:
        """Open a pool with one thread per tree; stop any running tests at the end."""
        pool = ThreadPoolExecutor(len(self._trees))
        try:
            yield pool
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for tree in self._trees:
                tree.stop()
            pool.shutdown()

    @contextmanager
    def _borrow_tree(self) -> Iterator[Tree]:
        tree = self._free.get()
        try:
            yield tree
        finally:
            self._free.put(tree)

    def _compile(self, tree: Tree) -> None:
        """Compile the kernels for a copy, so that compilation does not count towards the first test."""
        words = [file for file in _COMPILING if (tree.folder / file).exists()]
        if words:
            tree.pytest(words, self.folder / f"log-{tree.folder.name}.txt", _MEASURED_WITHIN_S)

    def _measurements_path(self, file: str) -> Path:
        return self.folder / "covered" / f"{_flatten(file)}.json"

    def _measure_file(self, file: str, report: Report) -> Path:
        """Return the JSON file with the measurements of a test file, after measuring it if necessary."""
        kept = self._measurements_path(file)
        if not kept.exists():
            with self._borrow_tree() as tree, tempfile.TemporaryDirectory(dir=self.folder) as folder:
                report(f"measuring {file}")
                measured = _measure(tree, file, Path(folder))
                # The file is written completely or not at all.
                partial = Path(folder, "measured.json")
                partial.write_text(json.dumps(measured), encoding="utf-8")
                partial.replace(kept)
        return kept

    def _try(self, mutant: Mutant, covered: Covered, turn: int) -> Trial:
        start_s = time.perf_counter()
        tests = covered.choose(mutant, self.root)
        limit_s = _START_S + _TIMES_AS_LONG * covered.seconds(tests)
        asked, log = self.folder / f"tests-{turn}.txt", self.folder / f"log-{turn}.txt"
        asked.write_text("\n".join(tests), encoding="utf-8")
        with self._borrow_tree() as tree, tree.replace_source(mutant.path, mutant.after, turn):
            code = tree.pytest(["-x", f"@{asked}"], log, limit_s)
        if code == _NO_TESTS:
            raise RuntimeError(f"{log}: expected tests that cover {mutant.path}:{mutant.line}, found none")
        outcome = {None: TIMEOUT, 0: SURVIVED}.get(code, KILLED)
        return Trial(mutant, outcome, round(time.perf_counter() - start_s, 1), len(tests))


def _measure(tree: Tree, file: str, folder: Path) -> dict[str, Any]:
    """Return the durations and the covered lines of all tests in a file."""
    sources = [tree.folder / path for target in TARGETS.values() for path in target.source_files(tree.folder)]
    settings, times = folder / "coveragerc", folder / "times.json"
    settings.write_text(
        "[run]\nparallel = true\ncontext = ${PYTEST_CURRENT_TEST-}\n"
        f"data_file = {folder}/.coverage\ninclude =\n" + "".join(f"    {source}\n" for source in sources),
        encoding="utf-8",
    )
    variables = {"COVERAGE_PROCESS_START": str(settings), TIMES_FILE: str(times)}
    log = folder.parent / f"log-{_flatten(file)}.txt"
    tree.pytest(["-p", "mutate.measuring", file], log, _MEASURED_WITHIN_S, **variables)
    if not times.exists():
        raise RuntimeError(f"{log}: expected pytest to finish, found that it crashed or ran out of time")
    return json.loads(times.read_text(encoding="utf-8")) | {"lines": lines_run(folder, tree.folder)}


def _flatten(file: str) -> str:
    """Return the path of a Python file as a plain name, with - in place of /."""
    return file.removesuffix(".py").replace("/", "-")


def _read_outcomes(path: Path) -> dict[int, dict[str, Any]]:
    """Return the outcomes of an earlier run, by the position of the mutant in the draw."""
    if not path.exists():
        return {}
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return {line.pop("turn"): line for line in lines}


def _digest(root: Path) -> str:
    """Return a hash of the sources and tests as 12 hexadecimal digits."""
    digest = hashlib.sha256()
    for name in repository_files(root):
        if name.startswith(_PARTS):
            digest.update(name.encode() + b"\0" + hashlib.sha256((root / name).read_bytes()).digest())
    return digest.hexdigest()[:12]
