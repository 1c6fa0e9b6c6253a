"""The multiplications that bounds of a network may take, and those that are left."""

from __future__ import annotations

from ns_abstract.verify.network.cost_model import (
    ALLOWED_PRODUCTS,
    HOPELESS_WIDTH,
    PLANNED_PRODUCTS,
    BackwardRoute,
    cost_model_of,
    log_or_least,
)
from ns_abstract.verify.network.graph import Network

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
#: Ways that are tried.
_TRIED = 6


class WorkBudget:
    """Decides from the work spent on a cell whether further backward passes pay."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self.costs = cost_model_of(network)
        self.deep = self.costs.deep
        self.planned = self.costs.planned
        self.left = PLANNED_PRODUCTS if self.planned else ALLOWED_PRODUCTS
        self._bounded = dict(self.costs.bounded) if self.planned else {}
        self._spread: list[float] = []
        self._size = 1.0
        self._step: int | None = None

    @property
    def rests(self) -> set[int]:
        """Nodes on whose bounds passes from later nodes may end."""
        return self.costs.rests if self.planned else set()

    def learns(self, index: int, radius: float, size: float) -> None:
        """Record the width of the forms of node ``index``, the next or an earlier one (N1), and its magnitude."""
        self._spread[index:] = [radius, *self._spread[index + 1 :]]
        self._size = size or self._size

    def ways(self, index: int, count: int) -> tuple[list[BackwardRoute], float]:
        """Return routes for ``count`` rows of node ``index`` that are worth a trial, and the price of a product (N18).

        There are none if the form of the node is as tight, or the bounds of the outputs will be useless.
        """
        self._bounded[index] = float(count)
        plan = self.costs.plan(max(self.left, 1.0), self._spread[:index], self._size, self._bounded, self._step)
        self._step = plan.step
        if plan.widest > HOPELESS_WIDTH * self._size:
            self.left = 0.0
        if index not in plan.ways:
            return [], plan.rate
        ways = [way for way in self.costs.ways(index) if count * way.price <= self.left]
        ways.sort(key=lambda way: log_or_least(way.spread(self._spread, self._size)) + plan.rate * count * way.price)
        return ways[:_TRIED], plan.rate

    def nearest(self, index: int, count: int) -> BackwardRoute | None:
        """Return the longest affordable route of ``count`` rows of node ``index``, and spend its multiplications."""
        best = None
        for way in self.costs.ways(index):
            if count * way.price < _CHEAP * self.left:
                best = way
        if best is not None:
            self.left -= count * best.price
        return best

    def renews(self, part: float, products: float) -> bool:
        """Return whether all numbers of a node are refined for ``products`` if the fraction ``part`` is unstable."""
        return part > _RENEW or products < self._cheap

    @property
    def _cheap(self) -> float:
        """Multiplications that are spent on one node in any case: fewer where not all passes are affordable."""
        return _CHEAP * ALLOWED_PRODUCTS * min(1.0, ALLOWED_PRODUCTS / self.costs.total)

    def suffices(self, products: float) -> float:
        """Return the width, relative to a node's numbers, at which rows for all of them may stop early (N17)."""
        return 0.0 if products < self._cheap else _ENOUGH

    def takes(self, products: float) -> bool:
        """Spend ``products`` multiplications and return True if so many are left."""
        if products > self.left:
            return False
        self.left -= products
        return True

    def spares(self, products: float) -> None:
        """Give back ``products`` multiplications that were not used."""
        self.left += products

    def gains(self, width_left: float, part: float) -> bool:
        """Return whether passes pay that leave the fraction ``width_left`` of widths, if ``part`` is unstable."""
        return part > _RENEW or width_left < _WORTH

    def vain(self, width_left: float, unstable: float, part: float) -> bool:
        """Return whether to leave a node as it is, as passes leave too large a fraction of widths or of open signs.

        If the fraction ``part`` of its numbers that are unstable is large, later nodes are given up, too.
        """
        hopeless = width_left > _KEPT or unstable > _LOST
        if hopeless and part > _MOST:
            self.left = 0.0
        return hopeless
