"""The cost model of backward passes and refined neurons (docs/dev/design.md, N13, N17, N18).

A pass from a neuron may stop at the image, or earlier at a node with known bounds, which is cheaper and looser.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
import torch

from ns_abstract.verify.network.bilinear import Product
from ns_abstract.verify.network.coefficients import grid
from ns_abstract.verify.network.graph import Network
from ns_abstract.verify.network.layers import (
    Activation,
    ChannelEmbedding,
    Convolution,
    LeakyRelu,
    LinearLayer,
    Matrix,
    Pad,
    ScaleLayer,
    Sum,
)
from ns_abstract.verify.network.max_pooling import MaxPool
from ns_abstract.verify.network.sparse_layers import PairwiseDifferences, SparseMatrix, TransposedConvolution

#: Products of a convolution in the time in which a kernel passes one number of a row.
_PASSING = 40.0
#: A network is deep if rows for all of its numbers take more products than this; about a minute of one core.
_DEEP = 2e12
#: Products that rows for inner nodes may take in one cell of a deep network; about three minutes of one core.
ALLOWED_PRODUCTS = 5e12
#: Products that rows may take in one cell of a network whose rows end by plan; about six minutes of one core.
PLANNED_PRODUCTS = 1.5e13
#: Where rows for all numbers take so many times more than is allowed, they end by plan.
_OVER = 1.5
#: Plans that are compared at first, and to either side of one made before; in the first of them rows for all numbers
#: cost so much (a logarithm of widths). By how much rows have to be the better.
_STEPS, _LIKE, _DEAREST, _CLOSE = 64, 6, 2.0**18, 0.1
#: Factor between the prices of two ways.
_APART = 1.2
#: Part of its inputs that an activation passes on.
_ACTIVE = 0.5
#: Width, as a part of a node's numbers, that is close enough.
_FINE = 1e-4
#: What an activation adds to bounds of its input relative to these and to numbers' sizes, and rows of themselves.
_BENDS, _ROUNDS = 0.1, 5e-5
#: Width past which nothing is foreseen.
_HUGE = 1e100
#: Width of bounds, as a part of numbers, past which nothing is worth any rows if it is foreseen.
HOPELESS_WIDTH = 1e3
#: Numbers of a node that ways are tried with.
TRIALS = 32
#: Layers whose rows stay in their windows.
_WINDOWED = (Activation, ChannelEmbedding, Pad, Product, ScaleLayer, Sum)


Share = TypeVar("Share")
Part = TypeVar("Part")


class BackwardRoute(NamedTuple):
    """The route of a neuron's backward pass: where it stops, and its cost.

    Attributes:
        cut: The pass ends at nodes up to this one; 0: it ends at the image.
        price: Multiplications.
        rests: By node where it ends: the sum of its coefficients' magnitudes, estimated.
        passed: The same for nodes in front of an activation or a product that it passes through.
        maxima: The same for maxima that it passes through.
    """

    cut: int
    price: float
    rests: tuple[tuple[int, float], ...]
    passed: tuple[tuple[int, float], ...]
    maxima: tuple[tuple[int, float], ...]

    def spread(self, intermediate: list[float], size: float) -> float:
        """Return its estimated width, if earlier nodes' are ``intermediate`` wide, of numbers about ``size``."""
        total = 0.0
        for at, sum_ in self.rests:
            total += sum_ * intermediate[at]
        for at, sum_ in self.passed:
            total += sum_ * intermediate[at] * (_BENDS * intermediate[at] / size + _ROUNDS)
        for at, sum_ in self.maxima:
            # where numbers are as good as equal, nothing is known of the greatest but its bounds
            total += sum_ * intermediate[at]
        return total


class RefinementPlan(NamedTuple):
    """A plan of which neurons of a network are refined in a cell (N18).

    Attributes:
        ways: By node: the route of rows for all of its numbers.
        products, rate: Multiplications in all, and the price of one in logarithms of widths.
        widest: Largest predicted width of a node's bounds.
        step: Its number among the compared plans.
    """

    ways: dict[int, BackwardRoute]
    products: float
    widest: float
    rate: float
    step: int


class CostModel:
    """Estimates the multiplications of backward passes through one network."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self._ways: dict[int, list[BackwardRoute]] = {}

    def row(self, index: int) -> float:
        """Return the multiplications of a backward pass from one number of node ``index`` to the image."""
        return self.ways(index)[-1].price

    def ways(self, index: int) -> list[BackwardRoute]:
        """Return the routes of a pass from one number of node ``index``, the shortest first, the image's last."""
        if index not in self._ways:
            self._ways[index] = self._passed(index)
        return self._ways[index]

    @cached_property
    def _ends(self) -> set[int]:
        """Nodes at which passes may end early: those that are refined, and maxima."""
        ends = set()
        for k, node in enumerate(self.network.nodes, 1):
            if isinstance(node.layer, MaxPool):
                ends.add(k)
            if isinstance(node.layer, (Activation, Product)):
                ends.update(node.inputs)
        return ends

    @cached_property
    def rests(self) -> set[int]:
        """Nodes other than the image at which a pass from any node may end."""
        last = [0] * (len(self.network.nodes) + 1)
        for k, node in enumerate(self.network.nodes, 1):
            for source in node.inputs:
                last[source] = k
        rests: set[int] = set()
        for cut in self._ends:
            rests.update(k for k in range(1, cut + 1) if last[k] > cut)
        return rests

    def _passed(self, index: int) -> list[BackwardRoute]:
        """Return `ways`, computed by following the pass's windows node by node."""
        # rows and columns of a window, channels in use, and the coefficients' squares together
        windows, total, ways = {index: (1, 1, 1.0, 1.0)}, 0.0, []
        passed: list[tuple[int, float]] = []
        maxima: list[tuple[int, float]] = []
        for at in range(index, 0, -1):
            if at != index and at in self._ends:
                way = self._way(at, windows, total, passed, maxima)
                if not ways or way.price > _APART * ways[-1].price:
                    ways.append(way)
            if at not in windows:
                continue
            h, w, used, squares = windows.pop(at)
            if at != index and at in self._ends:
                chosen = maxima if isinstance(self.network.nodes[at - 1].layer, MaxPool) else passed
                chosen.append((at, _together(h * w * used, squares)))
            node = self.network.nodes[at - 1]
            layer = node.layer
            channels = grid(self.network.shape(at))[0]
            total += _PASSING * channels * h * w
            squares *= self._sizes[at][1]
            if isinstance(layer, Convolution):
                groups = layer.groups
                used = min(groups, max(used, 1.0)) * (grid(layer.input_shapes[0])[0] / groups)
            elif isinstance(layer, Activation):
                used *= _ACTIVE
            elif isinstance(layer, LinearLayer) and layer.mixes:
                used = float(max(grid(self.network.shape(source))[0] for source in node.inputs))
            whole = False
            if isinstance(layer, Convolution):
                total += float(layer.weight.numel()) * h * w
                size = layer.weight.shape[2:]
                h, w = (
                    (n - 1) * s + (k - 1) * d + 1
                    for n, s, k, d in zip((h, w), layer.stride, size, layer.dilation, strict=True)
                )
            elif isinstance(layer, MaxPool):
                extent = layer.steps.max(0) + 1
                h, w = ((n - 1) * s + int(e) for n, s, e in zip((h, w), layer.stride, extent, strict=True))
            elif isinstance(layer, Matrix):
                total += float(np.prod(layer.shape)) * layer.weight.shape[1]
                whole = True
            elif isinstance(layer, TransposedConvolution):
                total += float(np.prod(layer.input_shapes[0])) * float(np.prod(layer.weight.shape[1:]))
                whole = True
            elif isinstance(layer, (SparseMatrix, PairwiseDifferences)):
                entries = layer.weight.numel() if isinstance(layer, SparseMatrix) else 2 * int(np.prod(layer.shape))
                total += _PASSING * float(entries)
                whole = True
            elif not isinstance(layer, _WINDOWED):
                assert isinstance(layer, LinearLayer)
                whole = True
            for source in node.inputs:
                _, height, width = grid(self.network.shape(source))
                size = (height, width) if whole or h * w >= height * width else (h, w)
                window = windows.get(source, (0, 0, 0.0, 0.0))
                windows[source] = (
                    max(window[0], size[0]),
                    max(window[1], size[1]),
                    max(window[2], min(used, grid(self.network.shape(source))[0])),
                    window[3] + squares,
                )
        ways.append(self._way(0, windows, total, passed, maxima))
        return ways

    def _way(
        self,
        cut: int,
        windows: dict[int, tuple[int, int, float, float]],
        total: float,
        passed: list[tuple[int, float]],
        maxima: list[tuple[int, float]],
    ) -> BackwardRoute:
        """Return the route of a pass that has reached ``windows`` and is concretised there."""
        bounded = sum(grid(self.network.shape(at))[0] * h * w for at, (h, w, _, _) in windows.items())
        sums = {at: _together(h * w * used, squares) for at, (h, w, used, squares) in windows.items()}
        return BackwardRoute(cut, total + _PASSING * bounded, tuple(sums.items()), tuple(passed), tuple(maxima))

    @cached_property
    def _sizes(self) -> list[tuple[float, float]]:
        """By node: mean sums over one number's weights, of magnitudes and of squares."""
        sizes = [(1.0, 1.0)]
        for node in self.network.nodes:
            layer = node.layer
            if isinstance(layer, (Convolution, Matrix)):
                weight, count = layer.weight, float(layer.weight.shape[0])
            elif isinstance(layer, TransposedConvolution):
                weight = layer.weight
                count = float(np.prod(layer.shape)) / float(np.prod(layer.input_shapes[0][1:]))
            elif isinstance(layer, SparseMatrix):
                weight, count = layer.weight, float(np.prod(layer.shape))
            elif isinstance(layer, ScaleLayer):
                weight, count = layer.factor, float(layer.factor.numel())
            elif isinstance(layer, PairwiseDifferences):
                sizes.append((2.0, 2.0))
                continue
            else:
                part = _ACTIVE if isinstance(layer, Activation) else 1.0
                sizes.append((part, part))
                continue
            sizes.append((float(weight.abs().sum()) / count, float(weight.square().sum()) / count))
        return sizes

    @cached_property
    def bounded(self) -> dict[int, float]:
        """By node in front of an activation or a product: estimated count of its numbers that are refined."""
        costs: dict[int, float] = {}
        for node in self.network.nodes:
            if isinstance(node.layer, (Activation, Product)):
                # what is certainly cut off needs no rows
                cut = isinstance(node.layer, LeakyRelu) and node.layer.alpha == 0.0
                for source in node.inputs:
                    if self.network.depth[source] > 1:
                        size = float(np.prod(self.network.shape(source))) * (0.5 if cut else 1.0)
                        costs[source] = max(size, costs.get(source, 0.0))
        return costs

    def plan(
        self,
        allowed: float,
        intermediate: list[float],
        size: float,
        bounded: dict[int, float] | None = None,
        near: int | None = None,
    ) -> RefinementPlan:
        """Return the cheapest routes that keep all bounds tight enough, or else as tight as the budget allows.

        Args:
            allowed: Multiplications that the passes may take together.
            intermediate: Widths of the bounds of the first nodes.
            size: Typical magnitude of nodes' numbers.
            bounded: Better counts than `CostModel.bounded`, where known.
            near: `RefinementPlan.step` of an earlier plan; only similar plans are compared.
        """
        best, bounded = None, bounded or self.bounded
        first, past = (0, _STEPS) if near is None else (max(0, near - _LIKE), min(_STEPS, near + _LIKE + 1))
        for step in range(first, past):
            plan = self._plan(step, intermediate, size, bounded)
            if best is None or (plan.products <= allowed and plan.widest < best.widest):
                best = plan
            if best.widest <= _FINE * size:
                break
        assert best is not None
        return best

    def _plan(self, step: int, intermediate: list[float], size: float, bounded: dict[int, float]) -> RefinementPlan:
        """Return the plan in which every node takes the best route at one price of a multiplication."""
        spread, ways, total, widest = list(intermediate), {}, 0.0, 0.0
        rate = _DEAREST / self.total * 2.0 ** (-0.5 * step)
        for k in range(len(intermediate), len(self.network.nodes) + 1):
            node = self.network.nodes[k - 1]
            near = max(spread[source] for source in node.inputs)
            if isinstance(node.layer, Activation):
                near *= 1.0 + _BENDS * near / size
            near = min(near * self._sizes[k][0], _HUGE)
            count = bounded.get(k)
            if count is not None:
                score = log_or_least(near) - _CLOSE
                for way in self.ways(k):
                    widths = way.spread(spread, size)
                    value = log_or_least(widths) + rate * count * way.price
                    if value < score:
                        score, near, ways[k] = value, widths, way
                widest = max(widest, near)
            if k in ways:
                total += count * ways[k].price
            spread.append(near)
        return RefinementPlan(ways, total, widest, rate, step)

    @cached_property
    def nodes(self) -> list[tuple[int, float]]:
        """Nodes in front of an activation or a product, and the multiplications of passes from all of their numbers."""
        nodes = []
        for node in self.network.nodes:
            if isinstance(node.layer, (Activation, Product)) and self.network.depth[node.inputs[0]] > 1:
                for source in dict.fromkeys(node.inputs):
                    nodes.append((source, float(np.prod(self.network.shape(source))) * self.row(source)))
        return nodes

    @cached_property
    def total(self) -> float:
        """Multiplications of passes from every number in front of an activation or a product."""
        return sum(products for _, products in self.nodes)

    @property
    def deep(self) -> bool:
        """Whether passes are rationed, as all of them would cost too much (N13)."""
        return self.total > _DEEP

    @property
    def planned(self) -> bool:
        """Whether passes cost so much that each goes back only as far as it pays (N18)."""
        return self.total > max(_DEEP, _OVER * ALLOWED_PRODUCTS)


def log_or_least(value: float) -> float:
    """Return the logarithm of a number; of zero, that of a very small number."""
    return float(np.log(max(value, 2.0**-1000)))


def _together(count: float, squares: float) -> float:
    """Return the expected sum of magnitudes of ``count`` normally distributed numbers with a known sum of squares."""
    return float(np.sqrt(2.0 / np.pi * count * squares))


def cost_model_of(network: Network) -> CostModel:
    """Return the cost model of a network, made once."""
    costs = network.__dict__.get("_costs")
    if costs is None:
        costs = network.__dict__["_costs"] = CostModel(network)
    return costs


def on_threads(work: Callable[[Share], Part], parts: Iterable[Share], threads: int) -> Iterator[Part]:
    """Yield ``work`` of every part, in order, computed by several threads."""
    if threads < 2:
        yield from map(work, parts)
        return
    with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        # every part in a copy of the context, which says when work is to be given up
        waiting = [pool.submit(copy_context().run, work, part) for part in parts]
        try:
            for result in waiting:
                yield result.result()
        finally:
            for result in waiting:
                result.cancel()
