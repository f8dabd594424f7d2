"""A module as names, what each of them is, and where it has those of others from; without what computes nothing."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class Source:
    """A module.

    Attributes:
        names: The statements that define each name at its top level.
        rest: Those there that define none, such as calls.
        imports: Module and name that each name imported anywhere in it stands for; the name is empty for a module.
        idle: Of `imports` those that nothing in it uses: imported for what importing them does.
    """

    names: dict[str, list[ast.stmt]]
    rest: list[ast.stmt]
    imports: dict[str, tuple[str, str]]
    idle: frozenset[str]

    @classmethod
    def of(cls, text: str) -> Source:
        """Read a module."""
        tree, imports = ast.parse(text), dict[str, tuple[str, str]]()
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                imports |= {alias.asname or alias.name.split(".")[0]: (alias.name, "") for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                imports |= {a.asname or a.name: (node.module, a.name) for a in node.names}
        idle = frozenset(imports) - {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
        names, rest = dict[str, list[ast.stmt]](), list[ast.stmt]()
        for statement in _Bare().visit(tree).body:
            defined = _defined(statement)
            for name in defined:
                names.setdefault(name, []).append(statement)
            rest += [] if defined else [statement]
        return cls(names, rest, imports, idle)

    def statements(self, name: str) -> list[ast.stmt]:
        """Return what a name is; of "*", everything, and of "", what defines no name."""
        if name == "*":
            return [statement for each in self.names.values() for statement in each] + self.rest
        return self.names.get(name, []) if name else self.rest

    def meaning(self, name: str) -> list[str]:
        """Return that as texts, which are equal if they do the same."""
        return [ast.dump(statement) for statement in self.statements(name)]


def uses(statements: Iterable[ast.stmt]) -> Iterator[tuple[str, str]]:
    """Yield the names that statements use, each with the attribute that is asked of it, or ""."""
    nodes = [node for statement in statements for node in ast.walk(statement)]
    owners = {id(node.value) for node in nodes if isinstance(node, ast.Attribute)}
    for node in nodes:
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            yield node.value.id, node.attr
        elif isinstance(node, ast.Name) and id(node) not in owners:
            yield node.id, ""


def _defined(statement: ast.stmt) -> list[str]:
    """Return the names that a statement defines."""
    if isinstance(statement, ast.FunctionDef | ast.ClassDef):
        return [statement.name]
    targets = statement.targets if isinstance(statement, ast.Assign) else [getattr(statement, "target", None)]
    if not isinstance(statement, ast.Assign | ast.AnnAssign):
        return []
    return [node.id for target in targets if target for node in ast.walk(target) if isinstance(node, ast.Name)]


class _Bare(ast.NodeTransformer):
    """Takes away docstrings, annotations of functions, imports, and the words in which something fails."""

    def visit_Expr(self, node: ast.Expr) -> ast.AST | None:
        return None if isinstance(node.value, ast.Constant) else self.generic_visit(node)

    def visit_Raise(self, node: ast.Raise) -> ast.AST:
        return ast.Raise()

    def visit_Import(self, node: ast.Import) -> None: ...

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None: ...

    def visit_arg(self, node: ast.arg) -> ast.AST:
        return ast.arg(node.arg)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.returns = None
        return self.generic_visit(node)
