"""Weighted means of positive numbers, rewritten about their value at one input (docs/dev/design.md, N26)."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import torch
from torch import Tensor

from ns_abstract.verify.network.activations import Reciprocal
from ns_abstract.verify.network.bilinear import Product
from ns_abstract.verify.network.build import NetworkBuilder
from ns_abstract.verify.network.graph import Layer, Network, Node
from ns_abstract.verify.network.layers import Gather, Matrix
from ns_abstract.verify.network.sparse_layers import SparseMatrix


def centred(network: Network, image: Tensor) -> Network:
    """Return a network that is equal in real arithmetic, with weighted means rewritten about their values at an image.

    ``W x / sum(x)`` is ``m + (W - m) x / sum(x)`` for any m. Bounds of the quotient grow with the magnitude of the
    dividend, which is nearly zero close to ``image`` [1, *input_shape] if m is the value there. The network is returned
    unchanged if it has no such means, or a difference of weights is no float32. The result must not be bounded in
    float32, where it computes something else.
    """
    builder = NetworkBuilder(network.source, network.input_shape)
    values, new_number, changed = [image], [0], False

    def add(layer: Layer, *inputs: int, name: str = "", op: str = "") -> int:
        builder.nodes.append(Node(name, op, layer, inputs))
        return len(builder.nodes)

    for k, node in enumerate(network.nodes, 1):
        with torch.no_grad():
            values.append(node.layer([values[i] for i in node.inputs]))
        parts = _mean(network, k)
        moved = None if parts is None else _moved(node.layer, values[k])
        if parts is None or moved is None:
            new_number.append(add(node.layer, *(new_number[i] for i in node.inputs), name=node.name, op=node.op))
            continue
        changed, (weight, mean) = True, moved
        shape, one = (len(mean),), network.shape(parts[1])
        numerator = builder.matrix(new_number[parts[0]], weight, None)
        index = torch.zeros(len(mean), dtype=torch.int64)
        inverse = add(Gather((one,), shape, 0, 0, index), new_number[parts[1]])
        quotient = add(Product(shape), numerator, inverse)
        new_number.append(builder.scale(quotient, np.ones(()), mean))
    return builder.network(new_number[-1], network.output) if changed else network


def _moved(layer: Layer, value: Tensor) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the weights less whole numbers near ``value`` [1, out], and these numbers; None if that is inexact."""
    assert isinstance(layer, Matrix)
    mean = np.round(value.numpy()[0])
    if layer.offset is not None or not np.isfinite(mean).all():
        return None
    weight = layer.weight.numpy()
    moved = (weight - mean[:, None]).astype(np.float32).astype(np.float64)
    exact = (
        Fraction(m) == Fraction(w) - Fraction(t)
        for row, own, t in zip(moved, weight, mean, strict=True)
        for m, w in zip(row, own, strict=True)
    )
    return (moved, mean) if np.isfinite(moved).all() and all(exact) else None


def _mean(network: Network, k: int) -> tuple[int, int] | None:
    """Return nodes x and 1 / sum(x) if node ``k`` is a matrix applied to their product; else None."""

    def layer(index: int) -> object:
        return network.nodes[index - 1].layer if index else None

    def inputs(index: int) -> tuple[int, ...]:
        return network.nodes[index - 1].inputs

    # other types have constants that are known within bounds alone
    if not (type(layer(k)) is Matrix and isinstance(layer(inputs(k)[0]), Product)):
        return None
    for x, spread in (inputs(inputs(k)[0]), inputs(inputs(k)[0])[::-1]):
        gather = layer(spread)
        if type(gather) is not Gather or bool(gather.index.any()):
            continue
        inverse = inputs(spread)[0]
        if type(layer(inverse)) is not Reciprocal or len(network.shape(x)) != 1:
            continue
        total = layer(inputs(inverse)[0])
        if type(total) is not SparseMatrix or inputs(inputs(inverse)[0]) != (x,) or total.offset is not None:
            continue
        once = torch.equal(total.source.sort().values, torch.arange(network.shape(x)[0]))
        if once and not bool(total.to.any()) and bool((total.weight == 1.0).all()):
            return x, inverse
    return None
