"""Compare the tests of two commits: the numbers of tests and asserts, and the removed and added tests.

python -m release.compare_tests 8012339~1 HEAD
"""

import ast
import subprocess
from collections import Counter
from typing import Annotated

import typer


def read_test_files(commit: str) -> list[str]:
    """Return the sources of all Python files below `tests` at a commit."""
    listed = _run_git("ls-tree", "-r", "--name-only", commit, "tests").splitlines()
    return [_run_git("show", f"{commit}:{path}") for path in listed if path.endswith(".py")]


def count_tests(sources: list[str]) -> tuple[Counter[str], int]:
    """Return the number of test functions by name, and the number of `assert` statements."""
    names: Counter[str] = Counter()
    asserts = 0
    for node in (node for source in sources for node in ast.walk(ast.parse(source))):
        asserts += isinstance(node, ast.Assert)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name.startswith("test_"):
            names[node.name] += 1
    return names, asserts


def _run_git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], capture_output=True, encoding="utf-8", check=True)
    return done.stdout


def main(
    old: Annotated[str, typer.Argument(help="Older commit.")],
    new: Annotated[str, typer.Argument(help="Newer commit.")] = "HEAD",
) -> None:
    """Print both counts, then the removed (-) and added (+) tests. A renamed test appears in both lists."""
    (old_names, old_asserts), (new_names, new_asserts) = (
        count_tests(read_test_files(commit)) for commit in (old, new)
    )
    typer.echo(f"{old}: {old_names.total()} tests, {old_asserts} asserts")
    typer.echo(f"{new}: {new_names.total()} tests, {new_asserts} asserts")
    for sign, names in (("-", old_names - new_names), ("+", new_names - old_names)):
        for name in sorted(names.elements()):
            typer.echo(f"{sign} {name}")


if __name__ == "__main__":
    typer.run(main)
