"""A network as a checked list of nodes that can be evaluated and bounded."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor

from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.verify.network.activations import Sigmoid, Tanh
from ns_abstract.verify.network.bilinear import Product
from ns_abstract.verify.network.layers import Activation, LinearLayer, ScaleLayer, Shape
from ns_abstract.verify.network.max_pooling import MaxPool
from ns_abstract.verify.network.scalar_function import LibraryFunction

Layer = LinearLayer | Activation | Product | MaxPool
Value = TypeVar("Value")

#: Whether bounds hold for every float32 evaluation and the exact network, or for that alone.
NetworkArithmetic = Literal["float32", "real"]
_EXACT = "the network as the exact function of its stored weights"
#: What a certificate about a network covers, whatever the network.
GUARANTEE = (
    _EXACT,
    "every float32 (or more precise) evaluation that computes each layer as sums of products in any order, "
    "with or without fused multiply-add and with batch normalisation and scales folded or not: "
    "rounding is bounded and charged to the result",
    "not covered: evaluation in reduced precision (TF32, float16, bfloat16, int8), Winograd or FFT convolution",
)
_REAL = (
    f"{_EXACT}, and that alone (network arithmetic real)",
    "not covered: what float32 or any other rounding evaluation of the network computes",
)
_ELEMENTARY = (
    "exponentials, logarithms and error functions are taken to be evaluated within 2^-20 (assumed, not proved)"
)
_SIGMOIDAL = "sigmoid and tanh are taken to be evaluated within 2^-20 of the exact value (assumed, not proved)"


@dataclass(frozen=True, eq=False)
class Node:
    """One layer of a network, with its name and operator in the file, and the numbers of its inputs; 0 is the image."""

    name: str
    op: str
    layer: Layer
    inputs: tuple[int, ...]


class Network:
    """A feed-forward network.

    Args:
        source: The file.
        input_shape: One item, without the batch.
        nodes: In an order in which every node's inputs come before it; node k is ``nodes[k - 1]``.
        output_shape: One item of the last node, as in the file.
        output: The output's name in the file.
        whole_numbers: Whether it only takes whole numbers from 0 to 255.
        data: Files beside ``source`` that hold some of its constants.

    Attributes:
        stamp: Identity of the files as they were read (`ns_abstract.verify.network.load.network_stamp`).
    """

    stamp: Mapping[str, Any]

    def __init__(
        self,
        source: Path,
        input_shape: Shape,
        nodes: Sequence[Node],
        output_shape: Shape,
        output: str = "",
        whole_numbers: bool = False,
        data: Sequence[Path] = (),
    ) -> None:
        self.source = source
        self.input_shape = tuple(input_shape)
        self.nodes = tuple(nodes)
        self.output_shape = tuple(output_shape)
        self.output = output
        self.whole_numbers = whole_numbers
        self.data = tuple(data)
        self.stamp = {}

    def __getstate__(self) -> dict[str, Any]:
        fields = ("source", "input_shape", "nodes", "output_shape", "output", "whole_numbers", "data", "stamp")
        return {name: self.__dict__[name] for name in fields}

    @property
    def input_size(self) -> int:
        """Count of numbers of one image."""
        return int(np.prod(self.input_shape))

    @property
    def output_size(self) -> int:
        """Count of numbers of one output."""
        return int(np.prod(self.output_shape))

    @property
    def neuron_count(self) -> int:
        """Count of numbers of all nodes together, with the image."""
        return sum(int(np.prod(self.shape(k))) for k in range(len(self.nodes) + 1))

    def guarantee(self, arithmetic: NetworkArithmetic = "float32") -> tuple[str, ...]:
        """Return sentences on what certificates about this network cover, and what they do not."""
        if arithmetic == "real":
            return _REAL
        sigmoidal = any(isinstance(node.layer, (Sigmoid, Tanh)) for node in self.nodes)
        elementary = any(isinstance(node.layer, LibraryFunction) for node in self.nodes)
        return (*GUARANTEE, *[_SIGMOIDAL] * sigmoidal, *[_ELEMENTARY] * elementary)

    def shape(self, index: int) -> Shape:
        """Return the shape of one item of node ``index``."""
        return self.nodes[index - 1].layer.shape if index else self.input_shape

    @cached_property
    def readers(self) -> tuple[int, ...]:
        """How many inputs are connected to each node."""
        counts = [0] * (len(self.nodes) + 1)
        for node in self.nodes:
            for index in node.inputs:
                counts[index] += 1
        return tuple(counts)

    @cached_property
    def depth(self) -> tuple[int, ...]:
        """Number of layers that mix numbers on the longest path from the image to each node."""
        depths = [0]
        for node in self.nodes:
            mixes = not isinstance(node.layer, Activation) and node.layer.mixes
            depths.append(max(depths[index] for index in node.inputs) + mixes)
        return tuple(depths)

    @cached_property
    def scaled(self) -> frozenset[int]:
        """Nodes into whose weights a program may have folded scales: no activation is between (N2)."""
        groups = list(range(len(self.nodes) + 1))

        def group(k: int) -> int:
            while groups[k] != k:
                k = groups[k]
            return k

        plain = [False, *(not isinstance(node.layer, Activation) for node in self.nodes)]
        for k, node in enumerate(self.nodes, 1):
            for index in node.inputs:
                # siblings that read one node, too: what scales it may be folded into each
                if plain[k] and (plain[index] or not index):
                    groups[group(k)] = group(index)
        marked = {group(k) for k, node in enumerate(self.nodes, 1) if isinstance(node.layer, ScaleLayer)}
        return frozenset(k for k in range(1, len(self.nodes) + 1) if plain[k] and group(k) in marked)

    def __call__(self, images: Tensor) -> Tensor:
        """Evaluate images [B, *input_shape] to [B, output_size], in the images' type, differentiably."""
        if tuple(images.shape[1:]) != self.input_shape:
            raise ValueError(f"images [B, {', '.join(map(str, self.input_shape))}] expected, got {tuple(images.shape)}")
        values: list[Tensor | None] = [images]
        for _, node, inputs in self.walk(values):
            values.append(node.layer(inputs))
        assert values[-1] is not None
        return values[-1].reshape(images.shape[0], -1)

    def walk(
        self, values: list[Value | None], last: int | None = None, leave: Callable[[int], None] | None = None
    ) -> Iterator[tuple[int, Node, list[Value]]]:
        """Yield the nodes up to ``last``, with their numbers and inputs; the caller appends each node's value.

        ``values``: by node, those so far. One that no other node reads becomes None, or is left to ``leave``.
        """
        left = list(self.readers)
        for k, node in enumerate(self.nodes[:last], 1):
            check_cancelled()
            yield k, node, [value for index in node.inputs if (value := values[index]) is not None]
            for index in node.inputs:
                left[index] -= 1
                if not left[index]:
                    if leave is not None:
                        leave(index)
                    values[index] = None


def item(shape: Sequence[int]) -> str:
    """Return a shape as text for messages."""
    return "x".join(map(str, shape)) if shape else "a number"


def as_double(array: np.ndarray) -> Tensor:
    """Return a copy of a constant as a float64 tensor."""
    return torch.from_numpy(np.array(array, np.float64))
