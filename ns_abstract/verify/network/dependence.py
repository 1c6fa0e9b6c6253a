"""Which numbers of a network some rows on its outputs depend on: the others need no better bounds (design.md, V11)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ns_abstract.verify.network.coefficients import Coefficients, Float64, full, grid
from ns_abstract.verify.network.graph import Network
from ns_abstract.verify.network.layers import LinearLayer
from ns_abstract.verify.network.max_pooling import MaxPool


def dependence(network: Network, rows: Float64) -> dict[int, Tensor]:
    """Return by node [*shape] bool whether ``rows`` [k, output_size] depend on a number; plays no part in soundness."""
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
