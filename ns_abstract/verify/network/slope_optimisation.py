"""Optimised slopes (alpha) and multipliers (beta) of alpha-beta-CROWN (docs/dev/design.md, N14, N16)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ns_abstract.arithmetic.network_charges import OWN_LINE, UP
from ns_abstract.verify.network.bilinear import Product
from ns_abstract.verify.network.graph import Network
from ns_abstract.verify.network.layers import Activation, LinearLayer
from ns_abstract.verify.network.max_pooling import MaxPool
from ns_abstract.verify.network.relu_lines import along_lines
from ns_abstract.verify.network.slope_choices import LineChoice, ReluSlopes

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]

#: First step of slopes, what each is of the one before, and Adam's parts of what was known before.
FIRST_STEP, _DECAY, _FIRST, _SECOND = 0.3, 0.88, 0.8, 0.95
#: A preference: added to divisors that may be zero.
_NEXT_TO_NOTHING = 1e-30


@dataclass(frozen=True)
class SplitNeurons:
    """Neurons of one node of one cell whose activation phases are assumed (N16).

    Attributes:
        flat: [B] their flat positions.
        side: [R, B] 1 where a row assumes them to be >= 0, -1 where <= 0, 0 for neither.
        reference: [B] their reference.
        noise: [B] charge per coefficient: rounding of the node and of rows.
    """

    flat: Int64
    side: Float64
    reference: Float64
    noise: Float64

    def __getitem__(self, rows: np.ndarray) -> SplitNeurons:
        """Return the split neurons of some rows."""
        return replace(self, side=self.side[rows])

    def lagrangian_terms(self, multiplier: Float32) -> tuple[Float32, Float64]:
        """Return what multipliers [R, B] >= 0 add to rows: coefficients [R, B], and a lower bound [R] of the offset.

        A row is at least itself less ``multiplier * side * z``, as that product is not negative.
        """
        gained = -multiplier * self.side.astype(np.float32)
        size = np.abs(gained.astype(np.float64))
        room = size @ (self.noise + OWN_LINE * np.abs(self.reference)) * UP
        return gained, gained.astype(np.float64) @ self.reference - room


@dataclass
class OptimisedSlopes:
    """The slopes and multipliers of a cell's rows, and the rows' coefficients, by node.

    ``lines`` are as in `pass_activation`, with rows in place of cells; ``multiplier_terms``: positions and results of
    `SplitNeurons.lagrangian_terms`; ``trace`` [R, C, H, W] are coefficients on the output, and on the image (0).
    """

    lines: dict[int, Float32]
    multiplier_terms: dict[int, tuple[Int64, Float32, Float64]] = field(default_factory=dict)
    trace: dict[int, Float32] = field(default_factory=dict)

    def keep(self, at: int, value: Float32, number: Int64, count: int) -> None:
        """Store the coefficients of rows ``number`` of ``count`` on the output of node ``at``."""
        if at not in self.trace:
            self.trace[at] = np.zeros((count, *value.shape[1:]), np.float32)
        self.trace[at][number] = value


class _Adam:
    """The state of Adam's optimiser for one array."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._mean, self._square, self._count = np.zeros(shape), np.zeros(shape), 0

    def keep(self, rows: np.ndarray) -> None:
        """Drop all rows but these."""
        self._mean, self._square = self._mean[rows], self._square[rows]

    def step(self, g: Float64) -> Float64:
        """Return the step's directions, of magnitude about one, for derivatives ``g``."""
        self._count += 1
        self._mean += (1.0 - _FIRST) * (g - self._mean)
        self._square += (1.0 - _SECOND) * (g * g - self._square)
        size = np.sqrt(self._square / (1.0 - _SECOND**self._count)) + _NEXT_TO_NOTHING
        return self._mean / (1.0 - _FIRST**self._count) / size


class DualAscent:
    """Optimises slopes and multipliers of ``count`` rows of a cell by Adam's steps.

    Args:
        choices, lines: By node, the lines that rows may optimise, and the cell's lines [6, C, H, W].
        held: By node, numbers of the cell whose signs are assumed.
        phases: By node, phases [R, U] that rows assume for the neurons of its first choice: 1, -1, or 0 for none.
        step: The first step.
        multiplier_step: The first step of multipliers, in magnitudes of coefficients; None: that of slopes.
    """

    def __init__(
        self,
        choices: Mapping[int, Sequence[LineChoice]],
        lines: Mapping[int, Float32],
        count: int,
        held: Mapping[int, SplitNeurons] | None = None,
        phases: Mapping[int, NDArray[np.int8]] | None = None,
        step: float = FIRST_STEP,
        multiplier_step: float | None = None,
    ) -> None:
        self.choices, self.split, self.phases = choices, dict(held or {}), dict(phases or {})
        self._lines = {k: np.repeat(lines[k][:, None], count, 1) for k in choices}
        self.parameters = {
            k: [np.repeat(choice.start(lines[k].reshape(6, -1))[None], count, 0) for choice in own]
            for k, own in choices.items()
        }
        self.multipliers = {k: np.zeros((count, len(v.flat)), np.float32) for k, v in self.split.items()}
        self._steps = {k: [_Adam(v.shape) for v in own] for k, own in self.parameters.items()}
        self._multipliers = {k: _Adam(v.shape) for k, v in self.multipliers.items()}
        self._step, self._multiplier_step = step, step if multiplier_step is None else multiplier_step

    def keep(self, rows: np.ndarray) -> None:
        """Drop all rows but these."""
        self._lines = {k: np.ascontiguousarray(v[:, rows]) for k, v in self._lines.items()}
        self.parameters = {k: [v[rows] for v in own] for k, own in self.parameters.items()}
        self.multipliers = {k: v[rows] for k, v in self.multipliers.items()}
        self.split = {k: v[rows] for k, v in self.split.items()}
        self.phases = {k: v[rows] for k, v in self.phases.items()}
        for adam in (*(one for own in self._steps.values() for one in own), *self._multipliers.values()):
            adam.keep(rows)

    def lines(self) -> OptimisedSlopes:
        """Return the lines of every row: those of the cell, replaced where the row optimises."""
        for k, own in self.choices.items():
            # the others stay as they are
            lines = self._lines[k].reshape(6, len(self.parameters[k][0]), -1)
            for choice, parameter in zip(own, self.parameters[k], strict=True):
                if isinstance(choice, ReluSlopes):
                    choice.put(parameter, lines, self.phases.get(k))
                else:
                    choice.put(parameter, lines)
        return OptimisedSlopes(
            self._lines, {k: (held.flat, *held.lagrangian_terms(self.multipliers[k])) for k, held in self.split.items()}
        )

    def climb(
        self, slopes: Mapping[int, Sequence[Float64]], forces: Mapping[int, Float64], size: Mapping[int, float]
    ) -> None:
        """Take one step along the bounds' derivatives, [R, U] by slopes and [R, B] by multipliers, within the limits.

        ``size``: typical magnitude of rows' coefficients by node.
        """
        for k, own in self.choices.items():
            for number, choice in enumerate(own):
                moved = self.parameters[k][number] + self._step * self._steps[k][number].step(slopes[k][number])
                self.parameters[k][number] = choice.within(moved)
        for k in self.split:
            step = self._multiplier_step * size.get(k, 0.0)
            moved = self.multipliers[k] + step * self._multipliers[k].step(forces[k])
            self.multipliers[k] = np.maximum(moved, 0.0).astype(np.float32)
        self._step *= _DECAY
        self._multiplier_step *= _DECAY


def slope_derivatives(
    network: Network,
    image: Tensor,
    trace: Mapping[int, Float32],
    lines: Callable[[int], Float32],
    ascent: DualAscent,
    others: Mapping[int, Any],
    last: int,
) -> tuple[dict[int, list[Float64]], dict[int, Float64]]:
    """Return, by node, the derivatives of bounds by parameters [R, U] and by multipliers [R, B].

    A row's bound is a sum of products along its lines. Followed forwards from the image where the bound is attained,
    these lines give a value to every node. The derivative by a slope is the row's coefficient times the distance of
    that value from where the line touches; that by a multiplier is the value where it violates the assumed sign.

    Args:
        network: The network.
        image: [R, *input_shape] float32 relative to the reference, where each row's bound is attained.
        trace: Coefficients on the outputs of activations, products and maxima.
        lines: Returns those of an activation's node: [6, R, C, H, W].
        ascent: The rows' slopes, and neurons whose signs are assumed.
        others: By product or max pooling node, a function of rows and inputs that returns the output.
        last: The node at which the rows begin.
    """
    values: list[Tensor | None] = [image]
    held = ascent.split
    count, forces = image.shape[0], {}
    by_node = {k: [np.zeros(v.shape) for v in own] for k, own in ascent.parameters.items()}
    for k, node, inputs in network.walk(values, last):
        coefficients = trace.get(k)
        if isinstance(node.layer, LinearLayer):
            values.append(node.layer.apply(inputs))
        elif coefficients is None:
            values.append(torch.zeros((count, *node.layer.shape), dtype=image.dtype))
        elif isinstance(node.layer, (Product, MaxPool)):
            values.append(
                others[k](torch.from_numpy(coefficients), inputs).to(image.dtype).reshape(count, *node.layer.shape)
            )
        else:
            assert isinstance(node.layer, Activation)
            u = inputs[0].flatten(1).contiguous().numpy()
            result = np.empty(u.shape, np.float32)
            own = np.ascontiguousarray(lines(k)).reshape(6, -1, u.shape[1])
            along_lines(coefficients.reshape(count, -1), u, own, result)
            source = node.inputs[0]
            if source in held:
                here = held[source]
                forces[source] = -here.side * (u[:, here.flat] + here.reference)
            values.append(torch.from_numpy(result).reshape(inputs[0].shape))
            for number, choice in enumerate(ascent.choices.get(k, ())):
                at = choice.units
                coefficient = coefficients.reshape(count, -1)[:, at.flat].astype(np.float64)
                value = u[:, at.flat] + at.reference
                by_node[k][number] = choice.derivative(ascent.parameters[k][number], coefficient, value)
    return by_node, {k: forces.get(k, np.zeros((count, len(v.flat)))) for k, v in held.items()}
