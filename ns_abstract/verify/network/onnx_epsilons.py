"""Refuses norms whose epsilon onnxruntime would replace by 1e-5 (docs/dev/design.md, N27)."""

from __future__ import annotations

from pathlib import Path

import onnx

from ns_abstract.io.errors import InputError


def refuse_lost_epsilons(graph: onnx.GraphProto, path: Path) -> None:
    """Refuse a root of a mean plus a constant that onnxruntime fuses into a norm with another epsilon (N27).

    onnxruntime only finds the constant as the second operand, and among the values that no caller may replace.

    Raises:
        InputError: The file has such a root.
    """
    makers = {name: node.op_type for node in graph.node for name in node.output}
    roots = {name for node in graph.node if node.op_type == "Sqrt" for name in node.input}
    replaceable = {value.name for value in graph.input}
    for node in graph.node:
        if node.op_type != "Add" or roots.isdisjoint(node.output):
            continue
        first, second = (makers.get(name) == "ReduceMean" for name in node.input)
        if (second and not first) or (first and node.input[1] in replaceable):
            problem = "adds a mean and a number in a way in which onnxruntime takes 1e-5 for the number"
            fix = "write mean + epsilon, with epsilon a constant that is no input of the graph"
            field = f"node {node.name or node.output[0]} (Add)"
            raise InputError(problem, file=path, field=field, fix=fix)
