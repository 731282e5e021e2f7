"""Random selection of mutants, determined by a seed."""

import ast
import random
import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from difflib import unified_diff
from pathlib import Path

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators.operator import Operator

from mutate.operators import operators
from mutate.targets import TARGETS

Place = tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class Mutant:
    """Source file with one change.

    Attributes:
        target: Part of the package, as a key of TARGETS.
        path: Source file, relative to the repository's root.
        line: Line of the change, counted from 1.
        operator: Name of the operator that made the change.
        before: Complete original source.
        after: Complete changed source.
    """

    target: str
    path: str
    line: int
    operator: str
    before: str
    after: str

    def diff(self) -> str:
        """Return the change as a patch."""
        before, after = (text.splitlines(keepends=True) for text in (self.before, self.after))
        return "".join(unified_diff(before, after, f"a/{self.path}", f"b/{self.path}", n=2))


def draw(root: Path, count: int, seed: int) -> list[Mutant]:
    """Draw mutants at random places in all sources; a higher count extends the list of a lower one.

    At each place, one of the possible changes is drawn.
    """
    available = [
        (target, path, place, changes)
        for target, settings in TARGETS.items()
        for path in settings.source_files(root)
        for place, changes in sorted(places(root / path).items())
    ]
    rng = random.Random(seed)
    rng.shuffle(available)
    drawn: list[Mutant] = []
    for target, path, place, changes in available:
        if len(drawn) == count:
            break
        name, operator, occurrence = rng.choice(changes)
        before = (root / path).read_text(encoding="utf-8")
        after = mutate_code(before, operator, occurrence)
        if after is not None and _differs(before, after):
            drawn.append(
                Mutant(target=target, path=path, line=place[0], operator=name, before=before, after=after)
            )
    return drawn


def places(path: Path) -> dict[Place, list[tuple[str, Operator, int]]]:
    """Return the places (line, column) where a source can be changed, with operators and occurrences."""
    source = path.read_text(encoding="utf-8")
    left_out = list(_find_left_out(ast.parse(source)))
    nodes = list(ast_nodes(get_ast(source)))
    found = defaultdict(list)
    for name, operator in operators().items():
        starts = ((node, start) for node in nodes for start, _ in operator.mutation_positions(node))
        for occurrence, (node, place) in enumerate(starts):
            # To the operators, the `*` before keyword-only parameters looks like a product.
            is_mark = node.parent is not None and node.parent.type == "parameters"
            if not is_mark and not any(first <= place < last for first, last in left_out):
                found[place].append((name, operator, occurrence))
    return dict(found)


def _find_left_out(tree: ast.Module) -> Iterator[tuple[Place, Place]]:
    """Yield the ranges of code that are never mutated, such as annotations, errors and `/` between paths."""
    for node in ast.walk(tree):
        # The argument `strict` of zip is an assertion.
        is_assertion = isinstance(node, ast.keyword) and node.arg == "strict"
        is_for_types = isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div) and _is_path(node.left):
            yield _end(node.left), (node.right.lineno, node.right.col_offset)
        parts = [getattr(node, "annotation", None), getattr(node, "returns", None)]
        if isinstance(node, ast.Raise | ast.JoinedStr) or is_assertion or is_for_types:
            parts.append(node)
        yield from (((part.lineno, part.col_offset), _end(part)) for part in parts if part is not None)


def _end(node: ast.expr) -> Place:
    return node.end_lineno or node.lineno, node.end_col_offset or 0


def _is_path(node: ast.expr) -> bool:
    return bool(re.search(r"folder|path|Path|parent|\bout\b", ast.unparse(node)))


def _differs(before: str, after: str) -> bool:
    """Return whether the changed source is valid Python and a different program."""
    try:
        return ast.dump(ast.parse(before)) != ast.dump(ast.parse(after))
    except SyntaxError:
        return False
