"""Mutation operators: some from Cosmic Ray, and others for changes that Cosmic Ray lacks.

Cosmic Ray can replace each binary operator with eleven others. Any test would detect most of these, such as
`<<` between two floats, so only plausible replacements are used. Decorators are never removed, because no
test can detect a missing cache.
"""

import ast
from abc import abstractmethod
from collections.abc import Iterator
from typing import Any

from cosmic_ray.operators.operator import Example, Operator
from cosmic_ray.plugins import get_operator
from parso.python.tree import Keyword, Name, Number, PythonNode
from parso.tree import NodeOrLeaf

Position = tuple[tuple[int, int], tuple[int, int]]

_LARGE, _FACTOR = 100, 1000
_OF_COSMIC_RAY = (
    *(f"ReplaceBinaryOperator_{pair}" for pair in (
        "Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "FloorDiv_Mul", "Mod_FloorDiv", "Pow_Mul", "BitOr_BitAnd",
        "BitAnd_BitOr",
    )),
    *(f"ReplaceComparisonOperator_{pair}" for pair in (
        "Lt_LtE", "Lt_GtE", "LtE_Lt", "LtE_Gt", "Gt_GtE", "Gt_LtE", "GtE_Gt", "GtE_Lt",
        "Eq_NotEq", "NotEq_Eq", "Is_IsNot", "IsNot_Is",
    )),
    *(f"ReplaceUnaryOperator_Delete_{name}" for name in ("USub", "Not", "Invert")),
    "ReplaceTrueWithFalse", "ReplaceFalseWithTrue", "ReplaceAndWithOr", "ReplaceOrWithAnd", "AddNot",
    "ReplaceBreakWithContinue", "ReplaceContinueWithBreak", "ZeroIterationForLoop",
)  # fmt: skip


class _LeafOperator(Operator):
    """Operator that changes single leaves of the syntax tree."""

    def mutation_positions(self, node: NodeOrLeaf) -> Iterator[Position]:
        if self.applies(node):
            yield node.start_pos, node.end_pos

    def mutate(self, node: Any, index: int) -> Any:
        node.value = self.replacement(node.value)
        return node

    @abstractmethod
    def applies(self, node: NodeOrLeaf) -> bool:
        """Return whether this operator changes the leaf."""

    @abstractmethod
    def replacement(self, value: str) -> str:
        """Return the replacement for the text of a leaf."""


class ChangeNumber(_LeafOperator):
    """Operator that adds 1 to a small number and multiplies a large one by 1,000."""

    def applies(self, node: NodeOrLeaf) -> bool:
        return isinstance(node, Number)

    def replacement(self, value: str) -> str:
        number = ast.literal_eval(value)
        return repr(number + 1 if abs(number) < _LARGE else number * _FACTOR)

    @classmethod
    def examples(cls) -> tuple[Example, ...]:
        return Example("x = 1", "x = 2"), Example("x = 1e6", "x = 1000000000.0")


class LowerNumber(ChangeNumber):
    """Operator that subtracts 1 from a small number and divides a large one by 1,000."""

    def replacement(self, value: str) -> str:
        number = ast.literal_eval(value)
        if abs(number) < _LARGE:
            return f"({number - 1!r})"
        return repr(number // _FACTOR if isinstance(number, int) else number / _FACTOR)

    @classmethod
    def examples(cls) -> tuple[Example, ...]:
        return Example("x = 1", "x = (0)"), Example("x = 1e6", "x = 1000.0")


class SwapFunction(_LeafOperator):
    """Operator that replaces a function with its opposite."""

    PAIRS = (("min", "max"), ("minimum", "maximum"), ("any", "all"), ("floor", "ceil"), ("ones", "zeros"))
    OPPOSITES = dict(PAIRS) | {second: first for first, second in PAIRS}

    def applies(self, node: NodeOrLeaf) -> bool:
        if not isinstance(node, Name) or node.value not in self.OPPOSITES:
            return False
        following = node.get_next_leaf()
        return following is not None and following.value == "("

    def replacement(self, value: str) -> str:
        return self.OPPOSITES[value]

    @classmethod
    def examples(cls) -> tuple[Example, ...]:
        return (Example("x = min(y, 1)", "x = max(y, 1)"),)


class ReplaceIn(_LeafOperator):
    """Operator that replaces `in` with `not in`."""

    def applies(self, node: NodeOrLeaf) -> bool:
        in_comparison = node.parent is not None and node.parent.type == "comparison"
        return in_comparison and isinstance(node, Keyword) and node.value == "in"

    def replacement(self, value: str) -> str:
        return "not in"

    @classmethod
    def examples(cls) -> tuple[Example, ...]:
        return (Example("x = y in z", "x = y not in z"),)


class ReplaceNotIn(Operator):
    """Operator that replaces `not in` with `in`."""

    def mutation_positions(self, node: NodeOrLeaf) -> Iterator[Position]:
        if node.type == "comp_op" and node.get_code().split() == ["not", "in"]:
            yield node.start_pos, node.end_pos

    def mutate(self, node: Any, index: int) -> NodeOrLeaf:
        return Keyword("in", node.start_pos, prefix=" ")

    @classmethod
    def examples(cls) -> tuple[Example, ...]:
        return (Example("x = y not in z", "x = y in z"),)


class RemoveCall(Operator):
    """Operator that removes a call whose result is not used."""

    def mutation_positions(self, node: NodeOrLeaf) -> Iterator[Position]:
        if node.type == "simple_stmt" and isinstance(node, PythonNode):
            call = node.children[0]
            if call.type == "atom_expr" and call.get_last_leaf().value == ")":
                yield call.start_pos, call.end_pos

    def mutate(self, node: Any, index: int) -> NodeOrLeaf:
        call = node.children[0]
        node.children[0] = Keyword("pass", call.start_pos, prefix=call.get_first_leaf().prefix)
        return node

    @classmethod
    def examples(cls) -> tuple[Example, ...]:
        return (Example("path.unlink()\n", "pass\n"),)


class CatchNothing(Operator):
    """Operator that makes an `except` clause catch nothing."""

    def mutation_positions(self, node: NodeOrLeaf) -> Iterator[Position]:
        if node.type == "except_clause":
            yield node.start_pos, node.end_pos

    def mutate(self, node: Any, index: int) -> NodeOrLeaf:
        caught = node.children[1]
        node.children[1] = Name("()", caught.start_pos, prefix=" ")
        return node

    @classmethod
    def examples(cls) -> tuple[Example, ...]:
        return (
            Example("try: x\nexcept OSError as error: y", "try: x\nexcept () as error: y"),
            Example("try: x\nexcept (json.Error, OSError): y", "try: x\nexcept (): y"),
        )


class RemoveTranspose(Operator):
    """Operator that replaces a transposed matrix with the matrix itself."""

    def mutation_positions(self, node: NodeOrLeaf) -> Iterator[Position]:
        if node.type == "trailer" and node.get_code() == ".T":
            yield node.start_pos, node.end_pos

    def mutate(self, node: NodeOrLeaf, index: int) -> None:
        return None

    @classmethod
    def examples(cls) -> tuple[Example, ...]:
        return (Example("x = y @ z.T", "x = y @ z"),)


OUR_OWN: tuple[type[Operator], ...] = (
    ChangeNumber, LowerNumber, SwapFunction, ReplaceIn, ReplaceNotIn, RemoveCall, CatchNothing,
    RemoveTranspose,
)  # fmt: skip


def operators() -> dict[str, Operator]:
    """Return all operators by name."""
    theirs = {name: get_operator(f"core/{name}")() for name in _OF_COSMIC_RAY}
    return theirs | {operator.__name__: operator() for operator in OUR_OWN}
