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

#: Preferences. Fraction of unstable neurons of a node past which all of its neurons are refined,
_MANY_UNSTABLE = 0.01
#: share of the budget that one node may always take,
_SMALL_SHARE = 0.03
#: fraction of widths below which a refinement of stable neurons pays,
_NARROWED = 0.1
#: width, relative to a node's magnitude, at which expensive passes may stop,
_STOPPING_WIDTH = 0.03
#: fractions of widths kept and of neurons still unstable past which a node is left as it is,
_WIDTH_KEPT, _STILL_UNSTABLE = 0.9, 0.9
#: fraction of unstable neurons past which later nodes are left, too,
_HOPELESS_PART = 0.5
#: and routes that are tried.
_MOST_ROUTES = 6


class WorkBudget:
    """Decides from the work spent on a cell whether further backward passes pay."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self.costs = cost_model_of(network)
        self.deep = self.costs.deep
        self.planned = self.costs.planned
        self.left = PLANNED_PRODUCTS if self.planned else ALLOWED_PRODUCTS
        self._counts = dict(self.costs.refined_counts) if self.planned else {}
        self._widths: list[float] = []
        self._size = 1.0
        self._step: int | None = None

    @property
    def end_nodes(self) -> set[int]:
        """Nodes on whose bounds passes from later nodes may end."""
        return self.costs.end_nodes if self.planned else set()

    def record_width(self, index: int, radius: float, size: float) -> None:
        """Record the mean radius of the form of node ``index``, the next or an earlier one (N1), and its magnitude."""
        self._widths[index:] = [radius, *self._widths[index + 1 :]]
        self._size = size or self._size

    def routes(self, index: int, count: int) -> tuple[list[BackwardRoute], float]:
        """Return routes worth a trial for ``count`` neurons of node ``index``, and the price of a multiplication (N18).

        There are none if the plan leaves the node as it is, or predicts useless bounds.
        """
        self._counts[index] = float(count)
        plan = self.costs.plan(max(self.left, 1.0), self._widths[:index], self._size, self._counts, self._step)
        self._step = plan.step
        if plan.widest > HOPELESS_WIDTH * self._size:
            self.left = 0.0
        if index not in plan.routes:
            return [], plan.rate
        routes = [route for route in self.costs.routes(index) if count * route.price <= self.left]
        routes.sort(
            key=lambda route: (
                log_or_least(route.predicted_width(self._widths, self._size)) + plan.rate * count * route.price
            )
        )
        return routes[:_MOST_ROUTES], plan.rate

    def longest_affordable(self, index: int, count: int) -> BackwardRoute | None:
        """Return the longest affordable route of ``count`` neurons of node ``index``, or None, and spend its price."""
        best = None
        for route in self.costs.routes(index):
            if count * route.price < _SMALL_SHARE * self.left:
                best = route
        if best is not None:
            self.left -= count * best.price
        return best

    def refines_all(self, part: float, products: float) -> bool:
        """Return whether all neurons of a node are refined, for ``products``, if the fraction ``part`` is unstable."""
        return part > _MANY_UNSTABLE or products < self._small_amount

    @property
    def _small_amount(self) -> float:
        """Multiplications that are spent on one node in any case: fewer where not all passes are affordable."""
        return _SMALL_SHARE * ALLOWED_PRODUCTS * min(1.0, ALLOWED_PRODUCTS / self.costs.total)

    def stopping_width(self, products: float) -> float:
        """Return the width, relative to a node's magnitude, at which passes for all neurons may stop early (N17)."""
        return 0.0 if products < self._small_amount else _STOPPING_WIDTH

    def spend(self, products: float) -> bool:
        """Spend ``products`` multiplications and return True if so many are left."""
        if products > self.left:
            return False
        self.left -= products
        return True

    def refund(self, products: float) -> None:
        """Give back ``products`` multiplications that were not used."""
        self.left += products

    def pays(self, width_left: float, part: float) -> bool:
        """Return whether refining all neurons pays, if it leaves ``width_left`` of widths and ``part`` is unstable."""
        return part > _MANY_UNSTABLE or width_left < _NARROWED

    def is_futile(self, width_left: float, unstable: float, part: float) -> bool:
        """Return whether refining a node is futile: it leaves too large a fraction of widths, or of neurons unstable.

        If the fraction ``part`` of its neurons that are unstable is large, the rest of the budget is given up, too.
        """
        hopeless = width_left > _WIDTH_KEPT or unstable > _STILL_UNSTABLE
        if hopeless and part > _HOPELESS_PART:
            self.left = 0.0
        return hopeless
