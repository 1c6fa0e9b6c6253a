"""Which numbers of a network matter to rows on its outputs, and which inputs move it most (docs/dev/design.md, V11)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ns_abstract.verify.network.coefficients import Coefficients, Float64, full, grid
from ns_abstract.verify.network.graph import Network
from ns_abstract.verify.network.layers import LinearLayer
from ns_abstract.verify.network.max_pooling import MaxPool


def dependence(network: Network, rows: Float64) -> dict[int, Tensor]:
    """Return by node [*shape] bool whether ``rows`` [k, output_size] depend on a number; for heuristics only."""
    generator = np.random.default_rng(0)
    last, dependent = len(network.nodes), {}
    reached: dict[int, np.ndarray] = {last: (rows != 0.0).any(0)}
    for at in range(last, 0, -1):
        if at not in reached:
            continue
        node, used = network.nodes[at - 1], reached.pop(at)
        dependent[at] = torch.from_numpy(used).reshape(network.shape(at))
        # weights cancel by chance alone
        value = (used * generator.uniform(0.5, 1.0, used.shape)).astype(np.float32)
        start = Coefficients.whole(value.reshape(1, *grid(network.shape(at))))
        for place, source in enumerate(node.inputs):
            if isinstance(node.layer, LinearLayer):
                parts = node.layer.backward(Coefficients.whole(start.value.copy()))
                own = full(parts[place], network.shape(source), force=True).value.reshape(-1) != 0.0
            elif isinstance(node.layer, MaxPool):
                own = np.ones(int(np.prod(network.shape(source))), bool)
            else:
                own = used
            reached[source] = reached[source] | own if source in reached else own
    return dependent


def input_shares(network: Network, lower: Float64, upper: Float64) -> Float64:
    """Return the share [n] of each input in the motion of neurons in front of activations; for heuristics only.

    Each input alone goes from one end of the box ``lower`` to ``upper`` [n] to the other, the others being in the
    middle. A node's shares sum to one; the result is the mean over the nodes.
    """
    middle, total, nodes = 0.5 * (lower + upper), np.zeros(len(lower)), 0
    varies = np.flatnonzero(upper > lower)
    ends = np.tile(middle, (len(varies), 2, 1))
    number = np.arange(len(varies))
    ends[number, 0, varies], ends[number, 1, varies] = lower[varies], upper[varies]
    motions = np.array([_motions(network, torch.from_numpy(pair)) for pair in ends])
    for moved in motions.T:
        size = moved.sum()
        if 0.0 < size < np.inf:
            total[varies] += moved / size
            nodes += 1
    return total / max(1, nodes)


def _motions(network: Network, pair: Tensor) -> list[float]:
    """Return by nonlinear node the sum of its inputs' differences between two images [2, n]."""
    values: list[Tensor | None] = [pair.reshape(2, *network.input_shape)]
    motions = []
    for _, node, inputs in network.walk(values):
        if not isinstance(node.layer, LinearLayer):
            motions.append(float(sum((v[1] - v[0]).abs().sum() for v in inputs)))
        values.append(node.layer(inputs))
    return motions
