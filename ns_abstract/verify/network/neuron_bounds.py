"""Intermediate bounds by backward passes that start at single neurons (docs/dev/design.md, N5, N6, N18)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from ns_abstract.verify.network.backward import ROWS_AT_ONCE, BackwardPass
from ns_abstract.verify.network.coefficient_source import CoefficientSource
from ns_abstract.verify.network.coefficients import Coefficients, Float64, Int64, grid
from ns_abstract.verify.network.cost_model import on_threads
from ns_abstract.verify.network.forms import NodeForm
from ns_abstract.verify.network.intermediate_bounds import IntermediateBounds
from ns_abstract.verify.network.row_ascent import RowAscent
from ns_abstract.verify.network.stopping import BackwardBounds, BackwardTrace, NeuronTarget, StoppingCriterion
from ns_abstract.verify.network.work_budget import WorkBudget

#: Of an unstable neuron's ends the one farther from zero takes one in so many of the nearer one's steps.
_FEWER_STEPS = 4
#: Rows of a network that is not deep from which on several threads share them.
_ROWS_OF_A_THREAD = 128


def farther_steps(steps: int) -> int:
    """Return the optimisation steps for a neuron's end that is farther from zero, given those for the nearer one."""
    return steps // _FEWER_STEPS


class NeuronBounds:
    """Bounds chosen neurons of a node by backward passes that start at them.

    ``spared`` counts multiplications that rows saved by stopping early.
    """

    def __init__(
        self,
        intermediate: IntermediateBounds,
        backward: BackwardPass,
        schedule: WorkBudget,
        sharing: CoefficientSource,
        ascent: RowAscent,
    ) -> None:
        self.intermediate, self.network, self.backward = intermediate, intermediate.network, backward
        self.schedule, self.sharing = schedule, sharing
        self.ascent = ascent
        self.farther = RowAscent(intermediate, backward, farther_steps(ascent.steps), ascent.first)
        # rows in float64 pay where the network's own rounding is none
        self._number = intermediate.relaxations[0 if schedule.deep else -1].number
        self.spared = 0.0

    def bounded(
        self, index: int, form: NodeForm, where: Int64, goal: NeuronTarget | None, decides: bool, cut: int = 0
    ) -> NodeForm:
        """Return the form with bounds of the numbers ``where`` [R, (cell, channel, row, column)] of node ``index``.

        ``goal``: rows stop where it is reached; ``decides``: no bound is computed on the other side once the sign is
        known; ``cut``: all rows end at nodes up to it (N18).
        """
        item = self.network.shape(index)
        cell, flat = where[:, 0], np.ravel_multi_index(tuple(where[:, 1:].T), grid(item))
        at = torch.from_numpy(cell), torch.from_numpy(flat)
        # the likelier side first; what it decides needs no other
        reference = form.reference.flatten(1)[at].numpy()
        sign = np.where(reference + form.c.flatten(1)[at].numpy() >= 0.0, 1.0, -1.0)

        def enough(part: Int64, sign: Float64) -> StoppingCriterion | None:
            return None if goal is None else StoppingCriterion(goal, -sign * reference[part], sign < 0.0)

        bounds = self._one_hot(index, where, sign, enough(np.arange(len(where)), sign), cut)
        bounds.turn(sign < 0.0)
        lower, upper = form.lower.flatten(1).clone(), form.upper.flatten(1).clone()
        low = np.maximum(lower[at].numpy(), bounds.lower) + reference
        high = np.minimum(upper[at].numpy(), bounds.upper) + reference
        left = np.flatnonzero((low < 0.0) & (high > 0.0)) if decides else np.arange(len(where))
        again = self._one_hot(index, where[left], -sign[left], enough(left, -sign[left]), cut)
        again.turn(sign[left] > 0.0)
        bounds.meet(left, again, sign[left] < 0.0)
        if self.ascent.steps and not cut:
            self._climb(index, where, reference, bounds, decides)
            if decides and self.farther.steps:
                self._climb(index, where, reference, bounds, decides, farther=True)
        c, r = form.c.flatten(1).clone(), form.r.flatten(1).clone()
        a = form.a.flatten(2).movedim(1, -1).clone()
        center, radius = bounds.middle()
        better = radius < r[at]
        c[at] = torch.where(better, center[:, -1], c[at])
        a[at] = torch.where(better[:, None], center[:, :-1], a[at])
        r[at] = torch.where(better, radius, r[at])
        lower[at] = torch.maximum(lower[at], torch.from_numpy(bounds.lower))
        upper[at] = torch.minimum(upper[at], torch.from_numpy(bounds.upper))
        a = a.movedim(-1, 1).reshape(self.intermediate.count, self.intermediate.d, *item)
        c, r, lower, upper = (v.reshape(-1, *item) for v in (c, r, lower, upper))
        tight = replace(form, c=c, a=a, r=r, lower=lower, upper=upper)
        return self.intermediate.within(tight, tight.lower, tight.upper)

    def _climb(
        self, index: int, where: Int64, reference: Float64, bounds: BackwardBounds, decides: bool, farther: bool = False
    ) -> None:
        """Tighten ``bounds`` with slopes optimised for each row; planes stay.

        ``decides``: only unstable neurons, and only their end nearer to zero, on which the gap of their lines depends
        most, or with ``farther`` the other one.
        """
        shape, ascent = grid(self.network.shape(index)), self.farther if farther else self.ascent
        for side, ends in ((1.0, bounds.lower), (-1.0, bounds.upper)):
            low, high = bounds.lower + reference, bounds.upper + reference
            asked = (side * (high + low) >= 0.0) ^ farther
            at = np.flatnonzero((low < 0.0) & (high > 0.0) & asked) if decides else np.arange(len(where))
            if not len(at):
                continue
            cell, channel, y, x = (np.ascontiguousarray(v) for v in where[at].T)
            value = np.zeros((len(at), shape[0], 1, 1), self.intermediate.relaxations[-1].number)
            value[np.arange(len(at)), channel, 0, 0] = side
            best = BackwardBounds.unknown(len(at), self.intermediate.d)
            best.lower[:] = side * ends[at]
            ascent.climb(index, Coefficients(value, y, x), cell, best)
            ends[at] = side * best.lower

    def _one_hot(
        self, index: int, where: Int64, sign: Float64, enough: StoppingCriterion | None, cut: int = 0
    ) -> BackwardBounds:
        """Return bounds of ``sign`` [R] times single numbers [R, (cell, channel, row, column)] of node ``index``."""
        channels = grid(self.network.shape(index))[0]
        bounds = BackwardBounds.unknown(len(where), self.intermediate.d)
        step = min(self.sharing.most_rows, max(1, ROWS_AT_ONCE // (16 * channels)))
        threads = torch.get_num_threads() if self.schedule.deep or len(where) >= _ROWS_OF_A_THREAD else 1
        if threads > 1:
            # as many rows as stay together to the image
            step = min(step, max(16, -(-len(where) // (4 * threads))))

        def bound(first: int) -> tuple[Int64, BackwardBounds, BackwardTrace | None]:
            number = np.arange(first, min(len(where), first + step))
            cell, channel, y, x = (np.ascontiguousarray(v) for v in where[number].T)
            trace = self.sharing.trace(len(cell))
            value = np.zeros((len(cell), channels, 1, 1), np.float32 if trace is not None else self._number)
            value[np.arange(len(cell)), channel, 0, 0] = sign[number]
            criterion = None if enough is None else enough[number]
            part = self.backward.bound(index, Coefficients(value, y, x), cell, criterion, trace, cut)
            return number, part, trace

        for number, part, trace in on_threads(bound, range(0, len(where), step), threads):
            bounds.put(number, part)
            if self.schedule.deep:
                ends, count = np.unique(part.ended[part.ended > 0], return_counts=True)
                self.spared += sum(
                    n * self.schedule.costs.pass_price(int(at)) for at, n in zip(ends, count, strict=True)
                )
            if trace is not None:
                self.sharing.keep(index, where[number], sign[number], trace)
        return bounds
