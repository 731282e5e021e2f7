"""Random sample of the package's docstrings and error messages, for a review of their English.

python -m release.words --seed 1
"""

import ast
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

ROOT = Path(__file__).resolve().parent.parent
_DOCUMENTED = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the line and the text of each docstring."""
    for node in ast.walk(tree):
        if isinstance(node, _DOCUMENTED) and (text := ast.get_docstring(node)):
            yield node.body[0].lineno, text


def error_messages(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the line and the source of each raised error that has a message."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            texts = (part for part in ast.walk(node.exc) if isinstance(part, ast.Constant))
            if any(isinstance(part.value, str) and " " in part.value for part in texts):
                yield node.lineno, ast.unparse(node.exc)


def draw(seed: int, count: int, kind: str) -> list[str]:
    """Return a random sample of docstrings or errors, each with its file and line, sorted by file."""
    find = {"docstrings": docstrings, "errors": error_messages}[kind]
    found = [
        f"{path.relative_to(ROOT)}:{line}: {text}"
        for path in sorted((ROOT / "stereoweave").rglob("*.py"))
        for line, text in find(ast.parse(path.read_text(encoding="utf-8")))
    ]
    return sorted(random.Random(seed).sample(found, count))


def main(
    seed: Annotated[int, typer.Option(help="Random seed of the sample.")] = 1,
    docstring_count: int = 100,
    error_count: int = 40,
) -> None:
    """Print a random sample of docstrings and one of errors."""
    for kind, count in (("docstrings", docstring_count), ("errors", error_count)):
        typer.echo(f"\n# {count} {kind}, seed {seed}\n\n" + "\n\n".join(draw(seed, count, kind)))


if __name__ == "__main__":
    typer.run(main)
