"""A planted fault and where it lies: by function and syntax, so that formatting plays no part."""

from __future__ import annotations

import ast
import textwrap
from dataclasses import dataclass


@dataclass(frozen=True)
class Fault:
    """One planted fault.

    Attributes:
        name: What is wrong, in a few words.
        file: The file, relative to the package.
        place: Dotted name of the function or class in it; "" for the module.
        old: An expression or a statement that stands there exactly once.
        new: What replaces it.
        test: The test that has to fail, as pytest names it, relative to ``tests``.
        compiled: Whether the test runs with compiled kernels; interpreted ones would take too long.
    """

    name: str
    file: str
    place: str
    old: str
    new: str
    test: str
    compiled: bool = False


_DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)


def _defined(node: ast.AST) -> list[ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef]:
    """What is defined in ``node``, but for what is defined in that."""
    found = []
    for child in ast.iter_child_nodes(node):
        found += [child] if isinstance(child, _DEFINITIONS) else _defined(child)
    return found


def _definition(tree: ast.Module, place: str) -> ast.AST:
    found: ast.AST = tree
    for part in place.split(".") if place else []:
        inside = [node for node in _defined(found) if node.name == part]
        if len(inside) != 1:
            raise ValueError(f"{part} of {place} is defined {len(inside)} times, not once")
        found = inside[0]
    return found


def _shape(text: str) -> tuple[ast.AST, str]:
    module = ast.parse(textwrap.dedent(text))
    if len(module.body) != 1:
        raise ValueError(f"not one expression or statement: {text}")
    node = module.body[0]
    if isinstance(node, ast.Expr):
        node = node.value
    return node, ast.dump(node)


def apply(text: str, fault: Fault) -> str:
    """The source ``text`` with the fault.

    Raises:
        ValueError: What is to be replaced does not stand in its place exactly once.
    """
    wanted, shape = _shape(fault.old)
    place = _definition(ast.parse(text), fault.place)
    found = [node for node in ast.walk(place) if type(node) is type(wanted) and ast.dump(node) == shape]
    if len(found) != 1:
        raise ValueError(f"{fault.name}: found {len(found)} times in {fault.file}: {fault.place}, not once")
    (node,) = found
    # columns of ast are in bytes
    lines = [line.encode() for line in text.splitlines(keepends=True)]
    begin = sum(map(len, lines[: node.lineno - 1])) + node.col_offset  # type: ignore[attr-defined]
    end = sum(map(len, lines[: node.end_lineno - 1])) + node.end_col_offset  # type: ignore[attr-defined]
    new = textwrap.dedent(fault.new)
    if isinstance(node, ast.expr):
        new = "None" if new == "pass" else f"({new})"
    else:
        new = new.replace("\n", "\n" + " " * node.col_offset)  # type: ignore[attr-defined]
    whole = b"".join(lines)
    changed = (whole[:begin] + new.encode() + whole[end:]).decode()
    ast.parse(changed)
    return changed
