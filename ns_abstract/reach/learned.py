"""Dynamics in an ONNX file: one step as onnxruntime computes it, and bounds over linear sets (design.md, L6)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ns_abstract.arithmetic.rounding import LARGEST32, STORED_FLUSH, STORED_ROUNDING, STORED_UP
from ns_abstract.io.errors import InputError
from ns_abstract.verify.model import parametric
from ns_abstract.verify.network import ImageSets, OutputBounds, bound_outputs, load_network
from ns_abstract.verify.network.load import onnx_runner, require_unchanged

Float64 = NDArray[np.float64]

#: Bytes that bounds may take.
_MEMORY = 1 << 28


class LearnedDynamics:
    """``x' = f(x, u)`` of an ONNX file with one input [1, n + m] or [n + m], the n ``states`` before the controls.

    Its outputs are n numbers together, the next state.
    """

    name = "onnx"

    def __init__(self, file: Path, states: int) -> None:
        if file.suffix.lower() != ".onnx":
            raise InputError(f"has the ending {file.suffix!r}", file=file, fix="give an .onnx file")
        self.file, self.states = file, states
        self.network = load_network(file, vector=True)
        shape = list(self.network.input_shape)
        if len(shape) != 1 or shape[0] <= states:
            raise InputError(
                f"takes an input of {shape} for {states} states",
                file=file,
                fix=f"export it with an input [1, n + m] or [n + m]: {states} states, then one control or more",
            )
        if self.network.output_size != states:
            raise InputError(
                f"has {self.network.output_size} outputs for {states} states",
                file=file,
                fix="return the next state, and that alone",
            )
        self.controls = shape[0] - states
        self.about = f"x' = {file.name}(x, u), evaluated in float32"
        self._run = onnx_runner(file, self.network.output, self.network.input_shape)
        require_unchanged(self.network)

    def step(self, x: Float64, u: Float64) -> Float64:
        """Return the next state [n] as onnxruntime computes it, from a state [n] and a control [m]."""
        with np.errstate(over="ignore"):
            return self._run(np.concatenate([x, u])[None]).astype(np.float64)

    def bound(
        self, center: Float64, generators: Float64, radius: Float64, lower: Float64, upper: Float64
    ) -> OutputBounds | None:
        """Return lower bounds of the next state and of its negative over one linear set (L6).

        They hold for every float32 evaluation, and for the exact function, of all states and controls
        ``center + generators s + e`` with s in [-1, 1]^q and |e| <= radius that lie between ``lower`` and ``upper``.

        Args:
            center, radius, lower, upper: [n + m].
            generators: [n + m, q].

        Returns:
            Bounds [1, 2 n] with slopes in s; None: a number may leave the range of float32.
        """
        size = np.maximum(np.maximum(np.abs(lower), np.abs(upper)), np.abs(center))
        if not (size < LARGEST32).all():
            return None
        # a program that computes in float32 rounds states and controls first
        room = STORED_ROUNDING * size + STORED_FLUSH
        apart = (radius + room) * STORED_UP
        parts = generators, center - apart, generators, center + apart, lower - room, upper + room
        images = ImageSets(*(part[None] for part in parts))
        unit = np.eye(self.states)
        rows, zero = np.concatenate([unit, -unit]), np.zeros(2 * self.states)
        output_bounds = bound_outputs(self.network, parametric(images), rows, zero, memory=_MEMORY)
        return OutputBounds(output_bounds.lower, output_bounds.a[..., : images.dimensions], output_bounds.b)
