"""Small faults that can be planted in a module: one operator, constant, condition or statement replaced."""

from __future__ import annotations

import ast
import builtins
from dataclasses import dataclass

ROUNDING = 1e-6  # smaller constants are guards against rounding, whose size has no visible effect
_SWAPPED_OPERATORS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
_PAIRS = (
    ("min", "max"), ("any", "all"), ("argmin", "argmax"), ("minimum", "maximum"), ("zeros", "ones"),
    ("zeros_like", "ones_like"), ("floor", "ceil"), ("left", "right"), ("start", "end"), ("ascending", "descending"),
)  # fmt: skip
# Keywords that affect how something is computed, not the result.
_NO_NUMBER = frozenset(
    {"strict", "copy", "workers", "maxsize", "balanced_tree", "compact_nodes", "cache", "nogil", "assume_unique"}
)
# Sizes of portions, or choices between equivalent algorithms: assignments with them are skipped.
_PORTIONS = frozenset({
    "AT_ONCE", "MANY_ROWS", "MAX_SHARED", "ROWS_AT_ONCE", "_BLOCK_ROWS", "_BLOCK_UNITS", "_MAX_CELLS",
    "_MAX_NEIGHBOURS",
})  # fmt: skip
_LEFT_ALONE = (ast.Raise, ast.Assert, ast.JoinedStr, ast.Import, ast.ImportFrom, ast.Lambda)
_SWAPPED_NAMES = {a: b for pair in _PAIRS for a, b in (pair, pair[::-1])}


@dataclass(frozen=True)
class Mutant:
    """A fault: the bytes ``start`` to ``end`` of a module become ``text``; ``where`` is the enclosing function.

    ``before`` and ``after`` are the affected lines from ``line`` on, joined into one line.
    """

    module: str
    where: str
    line: int
    start: int
    end: int
    text: str
    before: str
    after: str

    @property
    def key(self) -> tuple[str, str, str, str]:
        """An identifier independent of the lines above it."""
        return self.module, self.where, self.before, self.after

    def __str__(self) -> str:
        return f"{self.module}:{self.line} in {self.where}\n    - {self.before}\n    + {self.after}"


class _Faults(ast.NodeVisitor):
    """Every mutant of one module, except in texts, types, decorators and error messages."""

    def __init__(self, module: str, source: str) -> None:
        self.found: list[Mutant] = []
        self._module, self._source = module, source.encode()
        self._line_starts = [0]
        for line in self._source.splitlines(keepends=True):
            self._line_starts.append(self._line_starts[-1] + len(line))
        self._names: list[str] = []
        self.visit(ast.parse(source))

    def _add(self, node: ast.expr | ast.stmt, after: ast.AST | str) -> None:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        start = self._line_starts[node.lineno - 1] + node.col_offset
        end = self._line_starts[node.end_lineno - 1] + node.end_col_offset
        text = after if isinstance(after, str) else ast.unparse(ast.fix_missing_locations(after))
        if isinstance(after, ast.expr):
            text = f"({text})"
        head = self._source[self._line_starts[node.lineno - 1] : start].decode()
        tail = self._source[end : self._line_starts[node.end_lineno]].decode()
        before, after_line = (
            " ".join(f"{head}{middle}{tail}".split()) for middle in (self._source[start:end].decode(), text)
        )
        where = ".".join(self._names) or "module"
        self.found.append(Mutant(self._module, where, node.lineno, start, end, text, before, after_line))

    # compound nodes

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        self._names.append(node.name)
        for default in (*node.args.defaults, *(one for one in node.args.kw_defaults if one is not None)):
            self.visit(default)
        for statement in node.body:
            self.visit(statement)
        self._names.pop()

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        self._names.append(node.name)
        for statement in node.body:
            self.visit(statement)
        self._names.pop()

    # skipped nodes

    def visit(self, node: ast.AST) -> None:
        is_portion = isinstance(node, ast.Assign | ast.AnnAssign) and any(
            isinstance(part, ast.Name) and part.id in _PORTIONS for part in ast.walk(node)
        )
        if not isinstance(node, _LEFT_ALONE) and not is_portion:
            super().visit(node)

    def visit_keyword(self, node: ast.keyword) -> None:
        if node.arg not in _NO_NUMBER:
            self.visit(node.value)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_Subscript(self, node: ast.Subscript) -> None:
        # ``dict[str, int]`` in an assignment is a type; lower-case names are indexed by numbers
        if not (isinstance(node.value, ast.Name) and (hasattr(builtins, node.value.id) or node.value.id[0].isupper())):
            self.generic_visit(node)

    # statements

    def visit_Expr(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Call):
            self._add(node, "pass")
            self.generic_visit(node)

    def visit_Assign(self, node: ast.Assign) -> None:
        if all(isinstance(target, ast.Subscript | ast.Attribute) for target in node.targets):
            self._add(node, "pass")
        if not any(isinstance(target, ast.Name) and target.id.startswith("__") for target in node.targets):
            self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        self._add(node, "pass")
        swapped = _SWAPPED_OPERATORS.get(type(node.op))
        if swapped is not None and not _is_text(node.value):
            self._add(node, ast.AugAssign(node.target, swapped(), node.value))  # type: ignore[arg-type]
        self.generic_visit(node)

    def visit_Continue(self, node: ast.Continue) -> None:
        self._add(node, "pass")

    # expressions

    def visit_Compare(self, node: ast.Compare) -> None:
        for index, operator in enumerate(node.ops):
            operators = [*node.ops]
            operators[index] = _SWAPPED_OPERATORS[type(operator)]()  # type: ignore[call-overload]
            self._add(node, ast.Compare(node.left, operators, node.comparators))
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        self._add(node, ast.BoolOp(_SWAPPED_OPERATORS[type(node.op)](), node.values))  # type: ignore[arg-type]
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        swapped = _SWAPPED_OPERATORS.get(type(node.op))
        if swapped is not None and not _is_text(node.left) and not _is_text(node.right):
            self._add(node, ast.BinOp(node.left, swapped(), node.right))  # type: ignore[arg-type]
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        self._add(node, node.operand)
        self.generic_visit(node)

    def visit_IfExp(self, node: ast.IfExp) -> None:
        self._add(node, ast.IfExp(node.test, node.orelse, node.body))
        self.generic_visit(node)

    def visit_If(self, node: ast.If) -> None:
        if not isinstance(node.test, ast.Compare | ast.UnaryOp | ast.BoolOp):
            self._add(node.test, ast.UnaryOp(ast.Not(), node.test))
        self.generic_visit(node)

    def visit_comprehension(self, node: ast.comprehension) -> None:
        for test in node.ifs:
            self._add(test, "True")
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        function = node.func
        name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
        if name in _SWAPPED_NAMES and isinstance(function, ast.Attribute):
            swapped = ast.Attribute(function.value, _SWAPPED_NAMES[name], ast.Load())
            self._add(function, ast.unparse(swapped))
        elif name in _SWAPPED_NAMES:
            self._add(function, _SWAPPED_NAMES[name])
        self.visit(function)
        for argument in (*node.args, *node.keywords):
            # any negative size in a new shape is inferred
            if not (name == "reshape" and isinstance(argument, ast.UnaryOp)):
                self.visit(argument)

    def visit_Constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, bool):
            self._add(node, repr(not value))
        elif isinstance(value, int):
            self._add(node, repr(value + 1))
        elif isinstance(value, float) and not 0.0 < value < ROUNDING:
            self._add(node, repr(value * 1.5 if value else 1.0))
        elif isinstance(value, str) and value in _SWAPPED_NAMES:
            self._add(node, repr(_SWAPPED_NAMES[value]))


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def mutants_of(module: str, source: str) -> list[Mutant]:
    """All faults that can be planted in ``source``, each once, in order of position."""
    return list(dict.fromkeys(_Faults(module, source).found))


def planted(source: str, mutant: Mutant) -> str:
    """The source with the fault in it."""
    data = source.encode()
    return (data[: mutant.start] + mutant.text.encode() + data[mutant.end :]).decode()
