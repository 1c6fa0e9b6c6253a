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

#: Preference: a convolution makes so many multiplications in the time in which a kernel passes one coefficient on.
_PASSING = 40.0
#: Preference: a network is deep if refining all of its neurons takes more multiplications; a minute of one core.
_DEEP = 2e12
#: Preference: multiplications for inner neurons in one cell of a deep network; about three minutes of one core.
ALLOWED_PRODUCTS = 5e12
#: Preference: multiplications in one cell where backward passes end by plan; about six minutes of one core.
PLANNED_PRODUCTS = 1.5e13
#: Preference: where refining all neurons takes so many times what is allowed, backward passes end by plan.
_OVER = 1.5
#: Preferences: plans that are compared at first, and on either side of an earlier plan; the price of all passes in the
#: first plan, and the least gain of a pass, both in logarithms of widths.
_STEPS, _LIKE, _DEAREST, _CLOSE = 64, 6, 2.0**18, 0.1
#: Preference: a longer route costs at least so many times the shorter one.
_APART = 1.2
#: Estimate: the fraction of its inputs that an activation passes on.
_ACTIVE = 0.5
#: Preference: width, relative to a node's magnitude, that is tight enough.
_FINE = 1e-4
#: Estimates: the widening by an activation, relative to its input's width squared over magnitude, and by a pass itself.
_BENDS, _ROUNDS = 0.1, 5e-5
#: Largest width that is predicted.
_HUGE = 1e100
#: Preference: predicted width, relative to magnitudes, past which no backward pass is worth its price.
HOPELESS_WIDTH = 1e3
#: Preference: neurons of a node with which routes are tried.
TRIALS = 32
#: Layers through which the coefficients of a neuron stay in their window.
_WINDOWED = (Activation, ChannelEmbedding, Pad, Product, ScaleLayer, Sum)


Share = TypeVar("Share")
Part = TypeVar("Part")


class BackwardRoute(NamedTuple):
    """The route of a neuron's backward pass: where it stops, and its cost.

    Attributes:
        cut: The pass ends at nodes up to this one; 0: it ends at the image.
        price: Multiplications.
        ends: By node where it ends: the sum of its coefficients' magnitudes, estimated.
        relaxed: The same for nodes in front of an activation or a product that it passes through.
        maxima: The same for maxima that it passes through.
    """

    cut: int
    price: float
    ends: tuple[tuple[int, float], ...]
    relaxed: tuple[tuple[int, float], ...]
    maxima: tuple[tuple[int, float], ...]

    def predicted_width(self, intermediate: list[float], size: float) -> float:
        """Return the predicted width of bounds by this route, given the widths of earlier nodes and their magnitude."""
        total = 0.0
        for at, sum_ in self.ends:
            total += sum_ * intermediate[at]
        for at, sum_ in self.relaxed:
            total += sum_ * intermediate[at] * (_BENDS * intermediate[at] / size + _ROUNDS)
        for at, sum_ in self.maxima:
            # among nearly equal numbers, the greatest is known by its bounds alone
            total += sum_ * intermediate[at]
        return total


class RefinementPlan(NamedTuple):
    """A plan of which neurons of a network are refined in a cell (N18).

    Attributes:
        routes: By node: the route of the backward passes of all of its neurons.
        products, rate: Multiplications in all, and the price of one in logarithms of widths.
        widest: Largest predicted width of a node's bounds.
        step: Its number among the compared plans.
    """

    routes: dict[int, BackwardRoute]
    products: float
    widest: float
    rate: float
    step: int


class CostModel:
    """Estimates the multiplications of backward passes through one network."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self._routes: dict[int, list[BackwardRoute]] = {}

    def pass_price(self, index: int) -> float:
        """Return the multiplications of a backward pass from one number of node ``index`` to the image."""
        return self.routes(index)[-1].price

    def routes(self, index: int) -> list[BackwardRoute]:
        """Return the routes of a pass from one number of node ``index``, the shortest first, the image's last."""
        if index not in self._routes:
            self._routes[index] = self._computed_routes(index)
        return self._routes[index]

    @cached_property
    def _possible_ends(self) -> set[int]:
        """Nodes at which passes may end early: those that are refined, and maxima."""
        ends = set()
        for k, node in enumerate(self.network.nodes, 1):
            if isinstance(node.layer, MaxPool):
                ends.add(k)
            if isinstance(node.layer, (Activation, Product)):
                ends.update(node.inputs)
        return ends

    @cached_property
    def end_nodes(self) -> set[int]:
        """Nodes other than the image at which a pass from any node may end."""
        last = [0] * (len(self.network.nodes) + 1)
        for k, node in enumerate(self.network.nodes, 1):
            for source in node.inputs:
                last[source] = k
        end_nodes: set[int] = set()
        for cut in self._possible_ends:
            end_nodes.update(k for k in range(1, cut + 1) if last[k] > cut)
        return end_nodes

    def _computed_routes(self, index: int) -> list[BackwardRoute]:
        """Return `routes`, computed by following the pass's windows node by node."""
        # by node: height and width of the window, channels in use, and the sum of squared coefficients
        windows, total, routes = {index: (1, 1, 1.0, 1.0)}, 0.0, []
        relaxed: list[tuple[int, float]] = []
        maxima: list[tuple[int, float]] = []
        for at in range(index, 0, -1):
            if at != index and at in self._possible_ends:
                route = self._route_to(at, windows, total, relaxed, maxima)
                if not routes or route.price > _APART * routes[-1].price:
                    routes.append(route)
            if at not in windows:
                continue
            h, w, used, squares = windows.pop(at)
            if at != index and at in self._possible_ends:
                chosen = maxima if isinstance(self.network.nodes[at - 1].layer, MaxPool) else relaxed
                chosen.append((at, _together(h * w * used, squares)))
            node = self.network.nodes[at - 1]
            layer = node.layer
            channels = grid(self.network.shape(at))[0]
            total += _PASSING * channels * h * w
            squares *= self._weight_sums[at][1]
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
        routes.append(self._route_to(0, windows, total, relaxed, maxima))
        return routes

    def _route_to(
        self,
        cut: int,
        windows: dict[int, tuple[int, int, float, float]],
        total: float,
        relaxed: list[tuple[int, float]],
        maxima: list[tuple[int, float]],
    ) -> BackwardRoute:
        """Return the route of a pass that has reached ``windows`` and is concretised there."""
        concretised = sum(grid(self.network.shape(at))[0] * h * w for at, (h, w, _, _) in windows.items())
        sums = {at: _together(h * w * used, squares) for at, (h, w, used, squares) in windows.items()}
        return BackwardRoute(cut, total + _PASSING * concretised, tuple(sums.items()), tuple(relaxed), tuple(maxima))

    @cached_property
    def _weight_sums(self) -> list[tuple[float, float]]:
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
    def refined_counts(self) -> dict[int, float]:
        """By node in front of an activation or a product: estimated count of neurons that are refined."""
        costs: dict[int, float] = {}
        for node in self.network.nodes:
            if isinstance(node.layer, (Activation, Product)):
                # neurons that a ReLU surely clips are not refined
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
        counts: dict[int, float] | None = None,
        near: int | None = None,
    ) -> RefinementPlan:
        """Return the cheapest routes that keep all bounds tight enough, or else as tight as the budget allows.

        Args:
            allowed: Multiplications that the passes may take together.
            intermediate: Widths of the bounds of the first nodes.
            size: Typical magnitude of nodes' numbers.
            counts: Better counts than `CostModel.refined_counts`, where known.
            near: `RefinementPlan.step` of an earlier plan; only similar plans are compared.
        """
        best, counts = None, counts or self.refined_counts
        first, past = (0, _STEPS) if near is None else (max(0, near - _LIKE), min(_STEPS, near + _LIKE + 1))
        for step in range(first, past):
            plan = self._plan(step, intermediate, size, counts)
            if best is None or (plan.products <= allowed and plan.widest < best.widest):
                best = plan
            if best.widest <= _FINE * size:
                break
        assert best is not None
        return best

    def _plan(self, step: int, intermediate: list[float], size: float, counts: dict[int, float]) -> RefinementPlan:
        """Return the plan in which every node takes the best route at one price of a multiplication."""
        widths_by_node, routes, total, widest = list(intermediate), {}, 0.0, 0.0
        rate = _DEAREST / self.total * 2.0 ** (-0.5 * step)
        for k in range(len(intermediate), len(self.network.nodes) + 1):
            node = self.network.nodes[k - 1]
            near = max(widths_by_node[source] for source in node.inputs)
            if isinstance(node.layer, Activation):
                near *= 1.0 + _BENDS * near / size
            near = min(near * self._weight_sums[k][0], _HUGE)
            count = counts.get(k)
            if count is not None:
                score = log_or_least(near) - _CLOSE
                for route in self.routes(k):
                    widths = route.predicted_width(widths_by_node, size)
                    value = log_or_least(widths) + rate * count * route.price
                    if value < score:
                        score, near, routes[k] = value, widths, route
                widest = max(widest, near)
            if k in routes:
                total += count * routes[k].price
            widths_by_node.append(near)
        return RefinementPlan(routes, total, widest, rate, step)

    @cached_property
    def refined_nodes(self) -> list[tuple[int, float]]:
        """Nodes in front of an activation or a product, and the multiplications of passes from all of their numbers."""
        nodes = []
        for node in self.network.nodes:
            if isinstance(node.layer, (Activation, Product)) and self.network.depth[node.inputs[0]] > 1:
                for source in dict.fromkeys(node.inputs):
                    nodes.append((source, float(np.prod(self.network.shape(source))) * self.pass_price(source)))
        return nodes

    @cached_property
    def total(self) -> float:
        """Multiplications of passes from every number in front of an activation or a product."""
        return sum(products for _, products in self.refined_nodes)

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
