"""What a network consists of, and what a cell of it will take, before any of it is bounded."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ns_abstract.verify.network.graph import Network, item
from ns_abstract.verify.network.layers import Activation, Convolution, Linear, Matrix
from ns_abstract.verify.network.maps import Sparse, TransposedConvolution
from ns_abstract.verify.network.products import Product

#: Numbers of float64 that every number of every layer takes in one cell, beside three for each parameter.
_NUMBERS = 14
#: Bytes of rows under way, whatever the network.
_ROWS = 200 << 20
#: Products a second of one core, of forms and of rows; measured on small and middling networks.
_SPEED = 1.5e9
#: Part of all units that rows are passed back for, in sets that are worth a proof.
_OPEN = 0.1


def products(network: Network, index: int) -> float:
    """Products that one evaluation of node ``index`` takes."""
    layer = network.nodes[index - 1].layer
    size = float(np.prod(layer.shape))
    if isinstance(layer, Convolution):
        return size * float(np.prod(layer.weight.shape[1:]))
    if isinstance(layer, Matrix):
        return size * layer.weight.shape[1]
    if isinstance(layer, TransposedConvolution):
        return float(np.prod(layer.input_shapes[0])) * float(np.prod(layer.weight.shape[1:]))
    if isinstance(layer, Sparse):
        return float(layer.weight.numel())
    return size


def estimate(network: Network, dimensions: int) -> tuple[float, float]:
    """(bytes, seconds of one core) of one cell in ``dimensions`` parameters; the seconds are rough."""
    count = len(network.nodes)
    sizes = [float(np.prod(network.shape(k))) for k in range(count + 1)]
    memory = sum(sizes) * 8 * (3 * dimensions + _NUMBERS) + _ROWS
    work = [products(network, k) for k in range(1, count + 1)]
    forwards = 2.0 * sum(work) * (1 + dimensions)
    backwards = 0.0
    for k, node in enumerate(network.nodes, 1):
        if isinstance(node.layer, (Activation, Product)) and network.depth[node.inputs[0]] > 1:
            # a row sees a part of the maps, half of them as a rule
            backwards += _OPEN * sizes[k] * 0.5 * sum(work[: k - 1])
    return memory, (forwards + backwards) / _SPEED


def explain(network: Network, dimensions: int = 2) -> Sequence[str]:
    """Lines: every layer with its size, and an estimate of memory and time of one cell."""
    lines = [f"{network.source}: {item(network.input_shape)} -> {item(network.output_shape)}"]
    for k, node in enumerate(network.nodes, 1):
        kind = type(node.layer).__name__
        kind = "Reshape" if type(node.layer) is Linear else kind
        inputs = ", ".join(map(str, node.inputs))
        lines.append(f"{k:5d}  {kind:22s} {item(node.layer.shape):>14s}  of {inputs:12s} {node.op} {node.name}")
    total = sum(float(np.prod(network.shape(k))) for k in range(len(network.nodes) + 1))
    work = sum(products(network, k) for k in range(1, len(network.nodes) + 1))
    memory, seconds = estimate(network, dimensions)
    lines.append(f"{len(network.nodes)} layers, {total:,.0f} numbers, {work:,.0f} products an evaluation")
    lines.append(
        f"one cell in {dimensions} parameters: about {memory / 2**30:.2f} GiB, and {seconds:,.1f} s of one core "
        f"if one unit of {1 / _OPEN:.0f} is open"
    )
    lines += [f"covered: {line}" for line in network.guarantee()]
    return lines
