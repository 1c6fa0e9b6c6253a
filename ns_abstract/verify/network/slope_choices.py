"""Neurons whose relaxation rows may optimise: slopes of ReLUs, points of tangents (docs/dev/design.md, N14)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from ns_abstract.arithmetic.network_charges import OWN_SUMS
from ns_abstract.verify.network.coefficients import Floats
from ns_abstract.verify.network.layers import Activation, LeakyRelu
from ns_abstract.verify.network.relaxations import Relaxations
from ns_abstract.verify.network.relu_lines import write_relu_lines
from ns_abstract.verify.network.scalar_function import ScalarFunction, Tangents

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


@dataclass(frozen=True)
class UnstableNeurons:
    """The neurons of one node, in all cells, whose lines may be optimised.

    Attributes:
        cell, flat: [U] their cells and flat positions.
        lower, upper: [U] their bounds.
        reference, image: [U] references of their inputs and of their results.
        loose: [U] charge per slope: rounding of rows and of the layer before.
        room: [U] constant charge.
        layer: The activation behind them.
        relaxations: Those of rows that optimise.
    """

    cell: Int64
    flat: Int64
    lower: Float64
    upper: Float64
    reference: Float64
    image: Float64
    loose: Float64
    room: Float64
    layer: Activation
    relaxations: Relaxations

    def __getitem__(self, at: np.ndarray) -> UnstableNeurons:
        names = (entry.name for entry in fields(self) if entry.name not in ("layer", "relaxations"))
        return replace(self, **{name: getattr(self, name)[at] for name in names})

    def choices(self, cell: int) -> list[LineChoice]:
        """Return the lines of one cell's neurons that may be optimised; empty where there are none."""
        units = self[np.flatnonzero(self.cell == cell)]
        if isinstance(self.layer, LeakyRelu):
            return [ReluSlopes(units, self.layer.alpha)] if len(units.flat) else []
        assert isinstance(self.layer, ScalarFunction)
        chosen: list[LineChoice] = []
        for side in (-1.0, 1.0):
            tangents = Tangents.of(self.layer, torch.from_numpy(units.lower), torch.from_numpy(units.upper), side)
            at = (tangents.first < tangents.last).nonzero()[:, 0]
            if len(at):
                chosen.append(TangentPoints(units[at.numpy()], tangents[at]))
        return chosen

    def shifted(self, slope: Float64, low: Float64, high: Float64) -> tuple[Floats, Floats]:
        """Return offsets below and above, relative to the references, of lines with stored ``slope`` [R, U] (N4)."""
        base = slope * self.reference - self.image
        own = np.abs(self.reference) + np.abs(self.lower) + np.abs(self.upper)
        give = np.abs(slope) * self.loose + self.room + OWN_SUMS * (np.abs(self.image) + np.abs(low) + np.abs(high))
        give = give + OWN_SUMS * np.abs(slope) * own
        ends = ((low + base - give, -1.0), (high + base + give, 1.0))
        below, above = (self.relaxations.outward(torch.from_numpy(v), side).numpy() for v, side in ends)
        return below, above


class LineChoice(Protocol):
    """Lines of some neurons of a node, on one side, with a parameter for every row and neuron."""

    @property
    def units(self) -> UnstableNeurons:
        """The neurons."""
        ...

    def start(self, lines: Floats) -> Float64:
        """Return the parameters [U] of the cell's ``lines`` [6, N], approximately."""
        ...

    def within(self, parameter: Float64) -> Float64:
        """Return the closest allowed parameters."""
        ...

    def put(self, parameter: Float64, lines: Floats) -> None:
        """Write the lines of parameters [R, U] to ``lines`` [6, R, N]."""
        ...

    def derivative(self, parameter: Float64, coefficient: Float64, value: Float64) -> Float64:
        """Return the bounds' derivatives [R, U] by parameters, up to a factor, at the neurons' values."""
        ...


@dataclass(frozen=True)
class ReluSlopes:
    """Slopes from ``alpha`` to 1 of lower lines of unstable (leaky) ReLUs."""

    units: UnstableNeurons
    alpha: float

    def losses(self, coefficient: Floats) -> Float64:
        """Return the estimated loss [R, U] of rows with ``coefficient`` by the neurons' relaxation."""
        lower, upper = self.units.lower, self.units.upper
        gap = (1.0 - self.alpha) * upper * -lower / (upper - lower)
        # a slope below was chosen for the row, the line above could not be
        return np.where(coefficient < 0.0, 1.0, 0.5) * np.abs(coefficient) * gap

    def start(self, lines: Floats) -> Float64:
        return lines[0][self.units.flat].astype(np.float64)

    def within(self, parameter: Float64) -> Float64:
        return np.clip(parameter, self.alpha, 1.0)

    @cached_property
    def _units(self) -> Float64:
        """The [6, U] array of `write_relu_lines`."""
        units = self.units
        return np.stack([units.lower, units.upper, units.reference, units.image, units.loose, units.room])

    def put(self, parameter: Float64, lines: Floats, phases: NDArray[np.int8] | None = None) -> None:
        """`LineChoice.put`; where rows assume the neuron's phase [R, U], its exact piece (N16)."""
        relaxations = self.units.relaxations
        stored = np.empty(parameter.shape, relaxations.number)
        phases = np.zeros((0, 0), np.int8) if phases is None else np.ascontiguousarray(phases)
        write_relu_lines(
            np.ascontiguousarray(parameter), phases, self.alpha, self.units.flat, self._units, relaxations.moved_out,
            stored, lines,
        )  # fmt: skip

    def derivative(self, parameter: Float64, coefficient: Float64, value: Float64) -> Float64:
        return np.maximum(coefficient, 0.0) * value


@dataclass(frozen=True)
class TangentPoints:
    """Points at which tangents touch, as fractions of the way from the first to the last allowed one."""

    units: UnstableNeurons
    tangents: Tangents

    def _points(self, parameter: torch.Tensor) -> torch.Tensor:
        first, last = self.tangents.first, self.tangents.last
        return torch.minimum(torch.maximum(first + parameter * (last - first), first), last)

    def start(self, lines: Floats) -> Float64:
        first, last = self.tangents.first, self.tangents.last
        middle = 0.5 * (self.tangents.lower + self.tangents.upper)
        return ((middle - first) / (last - first)).clamp(0.0, 1.0).numpy()

    def within(self, parameter: Float64) -> Float64:
        return np.clip(parameter, 0.0, 1.0)

    def put(self, parameter: Float64, lines: Floats) -> None:
        touch = self._points(torch.from_numpy(parameter))
        slope, offset = (v.numpy() for v in self.tangents.line(touch, self.units.relaxations.dtype))
        lower, upper, flat = self.units.lower, self.units.upper, self.units.flat
        least, most = (v.numpy() for v in self.units.layer.range(self.tangents.lower, self.tangents.upper))
        # the other side of the row is asked for by nobody: any bound will do
        if self.tangents.side < 0.0:
            below, above = self.units.shifted(slope, offset, most - np.minimum(slope * lower, slope * upper))
            lines[0][:, flat], lines[1][:, flat], lines[2][:, flat] = slope, below, above
        else:
            below, above = self.units.shifted(slope, least - np.maximum(slope * lower, slope * upper), offset)
            lines[3][:, flat], lines[4][:, flat], lines[5][:, flat] = slope, above, below

    def derivative(self, parameter: Float64, coefficient: Float64, value: Float64) -> Float64:
        away = value - self._points(torch.from_numpy(parameter)).numpy()
        return np.maximum(-self.tangents.side * coefficient, 0.0) * away


def ascending(units: dict[int, UnstableNeurons], cell: int) -> dict[int, Sequence[LineChoice]]:
    """Return by node the lines that rows of a cell may optimise."""
    choices_of = {k: neurons.choices(cell) for k, neurons in units.items()}
    return {k: choices for k, choices in choices_of.items() if choices}
