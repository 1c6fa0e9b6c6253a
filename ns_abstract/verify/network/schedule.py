"""What rows cost, and how many of them a deep network is worth (docs/design.md, N13, N17)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import cached_property
from typing import TypeVar

import numpy as np
import torch

from ns_abstract.verify.network.graph import Network
from ns_abstract.verify.network.layers import Activation, Channels, Convolution, Linear, Matrix, Pad, Scale, Sum
from ns_abstract.verify.network.maps import Sparse, TransposedConvolution
from ns_abstract.verify.network.maxima import MaxPool
from ns_abstract.verify.network.products import Product
from ns_abstract.verify.network.rows import grid

#: Products of a convolution in the time in which a kernel passes one number of a row.
_PASSING = 40.0
#: A network is deep if rows for all of its numbers take more products than this; about a minute of one core.
_DEEP = 2e12
#: Products that rows for inner nodes may take in one cell of a deep network; about three minutes of one core.
_ALLOWED = 5e12
#: Once such a part of them is taken, rows are given up where what was passed foretells so many times more.
_SURE, _OVER = 0.05, 1.5
#: Layers that forms pass well, as a rule.
_TIGHT = 4
#: Part of a node's numbers past which all of them are bounded by rows.
_RENEW = 0.01
#: Part of what is allowed that rows of one node may take whatever is open.
_CHEAP = 0.03
#: Part of widths that these have to leave at most.
_WORTH = 0.1
#: Widths, as a part of a node's numbers, that rows of dearer nodes need not improve.
_ENOUGH = 0.03
#: Parts of widths and of signs not found out past which rows are given up.
_KEPT, _LOST = 0.9, 0.9
#: Part of a node's numbers that have to be open for that to end all.
_MOST = 0.5
#: Layers whose rows stay in their windows.
_WINDOWED = (Activation, Channels, Pad, Product, Scale, Sum)


Found = TypeVar("Found")


class Costs:
    """Products that rows of one network take."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self._rows: dict[int, float] = {}

    def row(self, index: int) -> float:
        """Products that a row of one number of node ``index`` takes to the image."""
        if index not in self._rows:
            self._rows[index] = self._passed(index)
        return self._rows[index]

    def _passed(self, index: int) -> float:
        """The same, window by window."""
        windows, total = {index: (1, 1)}, 0.0
        for at in range(index, 0, -1):
            if at not in windows:
                continue
            h, w = windows.pop(at)
            node = self.network.nodes[at - 1]
            layer = node.layer
            total += _PASSING * grid(self.network.shape(at))[0] * h * w
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
            elif isinstance(layer, Sparse):
                total += _PASSING * float(layer.weight.numel())
                whole = True
            elif not isinstance(layer, _WINDOWED):
                assert isinstance(layer, Linear)
                whole = True
            for source in node.inputs:
                _, height, width = grid(self.network.shape(source))
                size = (height, width) if whole or h * w >= height * width else (h, w)
                known = windows.get(source, (0, 0))
                windows[source] = max(known[0], size[0]), max(known[1], size[1])
        return total + _PASSING * float(np.prod(self.network.input_shape))

    @cached_property
    def nodes(self) -> list[tuple[int, float]]:
        """Nodes before an activation or a product, and the products that rows for all of their numbers take."""
        found = []
        for node in self.network.nodes:
            if isinstance(node.layer, (Activation, Product)) and self.network.depth[node.inputs[0]] > 1:
                for source in dict.fromkeys(node.inputs):
                    found.append((source, float(np.prod(self.network.shape(source))) * self.row(source)))
        return found

    @cached_property
    def total(self) -> float:
        """Products that rows for every number before an activation or a product take."""
        return sum(products for _, products in self.nodes)

    @property
    def deep(self) -> bool:
        """Whether rows are rationed (N13)."""
        return self.total > _DEEP

    def foreseen(self, part: float, deep: float) -> tuple[float, bool]:
        """Products that rows of one cell will take, and whether they are given up before the end (N13).

        Args:
            part, deep: Part of all numbers that are bounded by rows, in other networks and in deep ones.
        """
        if not self.deep:
            return part * self.total, False
        taken = passed = 0.0
        for index, products in self.nodes:
            passed += products
            if self.network.depth[index] <= _TIGHT:
                continue
            # where most of a node is open, rows bound all of it
            if _in_vain(taken + products, passed, self.total):
                return taken, True
            taken += deep * products
        return min(taken, _ALLOWED), False


def _in_vain(taken: float, passed: float, total: float) -> bool:
    """Whether rows would end on the way: ``taken`` of what all rows take up to a node, ``passed``, and to the end."""
    return taken > _SURE * _ALLOWED and taken * total > _OVER * _ALLOWED * passed


class Schedule:
    """How far the work of one cell has gone."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self.costs = costs_of(network)
        self.deep = self.costs.deep
        self.left = _ALLOWED
        self._taken = self._passed = 0.0

    def arrives(self, index: int) -> None:
        """The work is at node ``index``."""
        self._passed += float(np.prod(self.network.shape(index))) * self.costs.row(index)

    def renews(self, part: float, products: float) -> bool:
        """Whether all numbers of a node are bounded by rows, for ``products``, if ``part`` of them is open."""
        return part > _RENEW or products < self._cheap

    @property
    def _cheap(self) -> float:
        """Products that rows of one node may take whatever is open: fewer where not all rows can be afforded."""
        return _CHEAP * _ALLOWED * min(1.0, _ALLOWED / self.costs.total)

    def suffices(self, products: float) -> float:
        """Width, as a part of a node's numbers, at which rows for all of them may end on the way (N17)."""
        return 0.0 if products < self._cheap else _ENOUGH

    def takes(self, products: float) -> bool:
        """Whether so many products are left; they are taken then.

        Where rows would end on the way, what they are worth before is lost behind, so they are given up early.
        """
        taken = self._taken + products
        if products > self.left:
            return False
        if _in_vain(taken, self._passed, self.costs.total):
            self.left = 0.0
            return False
        self.left -= products
        self._taken = taken
        return True

    def spares(self, products: float) -> None:
        """So many products were not taken after all."""
        self.left += products
        self._taken -= products

    def gains(self, kept: float, part: float) -> bool:
        """Whether rows for all numbers are worth it that leave so large a part of widths, if ``part`` is open."""
        return part > _RENEW or kept < _WORTH

    def vain(self, kept: float, open_: float, part: float) -> bool:
        """Leave a node as it is if rows leave so large a part of widths, or of signs not found out.

        Where most of it is open, ``part``, the nodes behind it are given up, too.
        """
        given = kept > _KEPT or open_ > _LOST
        if given and part > _MOST:
            self.left = 0.0
        return given


def costs_of(network: Network) -> Costs:
    """The costs of a network, worked out once."""
    found = network.__dict__.get("_costs")
    if found is None:
        found = network.__dict__["_costs"] = Costs(network)
    return found


def on_threads(work: Callable[[int], Found], parts: Iterable[int], threads: int) -> Iterator[Found]:
    """``work`` of every part, in order; kernels and torch let other threads run meanwhile, each torch on one."""
    if threads < 2:
        yield from map(work, parts)
        return
    with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        # every part in a copy of the context, which says when work is to be given up
        waiting = [pool.submit(copy_context().run, work, part) for part in parts]
        try:
            for found in waiting:
                yield found.result()
        finally:
            for found in waiting:
                found.cancel()
