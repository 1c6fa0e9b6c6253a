"""Describe a network's layers and estimate the cost of a cell before anything is bounded."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ns_abstract.io.errors import InputError
from ns_abstract.verify.network.cost_model import cost_model_of
from ns_abstract.verify.network.graph import Network, item
from ns_abstract.verify.network.layers import Convolution, LinearLayer, Matrix
from ns_abstract.verify.network.sparse_layers import SparseMatrix, TransposedConvolution

#: Numbers of float64 that every number of every layer takes in one cell, beside three for each parameter.
_NUMBERS = 8
#: Bytes of rows under way and of weights in other orders: of a network whose rows are few, and of a deep one.
_FEW_ROWS, _MANY_ROWS = 128 << 20, 420 << 20
#: Products a second of one core: of forms in float64, and of rows in float32, few at a time, many, and many that end
#: by plan; measured.
_FORMS_SPEED, _FEW_SPEED, _MANY_SPEED, _PLANNED_SPEED = 1.5e9, 1.2e9, 3e10, 7e10
#: Seconds that a layer takes however small it is, the network's bounds of one cell by themselves; measured.
_LAYER_EACH = 2.5e-3
#: Seconds that the two rows of a number take besides where they end by plan: most are short; measured.
_PLANNED_EACH = 3.2e-5
#: Part of all units that rows are passed back for, in sets that are worth a proof; of a deep network most.
_OPEN, _DEEP_OPEN = 0.1, 0.4


def multiplications(network: Network, index: int) -> float:
    """Return the number of multiplications in one evaluation of node ``index``."""
    layer = network.nodes[index - 1].layer
    size = float(np.prod(layer.shape))
    if isinstance(layer, Convolution):
        return size * float(np.prod(layer.weight.shape[1:]))
    if isinstance(layer, Matrix):
        return size * layer.weight.shape[1]
    if isinstance(layer, TransposedConvolution):
        return float(np.prod(layer.input_shapes[0])) * float(np.prod(layer.weight.shape[1:]))
    if isinstance(layer, SparseMatrix):
        return float(layer.weight.numel())
    return size


def least_seconds(network: Network, dimensions: int) -> float:
    """Return the seconds (roughly) that a cell takes one core where no rows are passed back for units."""
    count = len(network.nodes)
    forwards = 2.0 * sum(multiplications(network, k) for k in range(1, count + 1)) * (1 + dimensions)
    return forwards / _FORMS_SPEED + _LAYER_EACH * count


def estimate(network: Network, dimensions: int) -> tuple[float, float, bool]:
    """Return a cell's bytes, seconds on one core (roughly), and whether backward passes are skipped."""
    count = len(network.nodes)
    sizes = [float(np.prod(network.shape(k))) for k in range(count + 1)]
    costs = cost_model_of(network)
    foreseen = costs.foreseen(_OPEN, _DEEP_OPEN)
    many = costs.deep and not foreseen.given_up
    memory = sum(sizes) * 8 * (3 * dimensions + _NUMBERS) + (_MANY_ROWS if many else _FEW_ROWS)
    speed = _PLANNED_SPEED if costs.planned else _MANY_SPEED if costs.deep else _FEW_SPEED
    seconds = least_seconds(network, dimensions) + foreseen.products / speed + _PLANNED_EACH * foreseen.neurons
    return memory, seconds, foreseen.given_up


def check_cell(
    network: Network, dimensions: int, allowed: float, remedy: str = "a larger --memory-limit, fewer --workers"
) -> None:
    """Raise InputError if one cell of the network takes more than ``allowed`` bytes, about.

    ``remedy`` is what may be given instead of a smaller network.
    """
    needed, _, _ = estimate(network, dimensions)
    if needed > allowed:
        raise InputError(
            f"needs about {needed / 2**30:.1f} GiB for a cell in {dimensions} parameters "
            f"({network.neuron_count:,} numbers), {allowed / 2**30:.1f} GiB are allowed",
            file=network.source,
            fix=f"give {remedy}, or a smaller network or image",
        )


def explain(network: Network, dimensions: int = 2) -> Sequence[str]:
    """Return lines of text: every layer with its size, and the estimated memory and time of one cell."""
    lines = [f"{network.source}: {item(network.input_shape)} -> {item(network.output_shape)}"]
    for k, node in enumerate(network.nodes, 1):
        kind = type(node.layer).__name__
        kind = "Reshape" if type(node.layer) is LinearLayer else kind
        inputs = ", ".join(map(str, node.inputs))
        lines.append(f"{k:5d}  {kind:22s} {item(node.layer.shape):>14s}  of {inputs:12s} {node.op} {node.name}")
    work = sum(multiplications(network, k) for k in range(1, len(network.nodes) + 1))
    memory, seconds, given_up = estimate(network, dimensions)
    lines.append(f"{len(network.nodes)} layers, {network.neuron_count:,} numbers, {work:,.0f} products an evaluation")
    lines.append(
        f"one cell in {dimensions} parameters: about {memory / 2**30:.2f} GiB, and for the network, of one core, "
        f"{least_seconds(network, dimensions):.2g} s where hardly a unit is unstable, {seconds:.2g} s where one of "
        f"{1 / _OPEN:.0f} is"
    )
    if given_up:
        lines.append("deep: rows for its units cost more than they may, so they are given up and bounds are wide")
    elif cost_model_of(network).planned:
        lines.append(
            "deep: rows end on the way; of sets for which that leaves nothing known they are given up after seconds"
        )
    lines += [line if line.startswith("not covered") else f"covered: {line}" for line in network.guarantee()]
    return lines
