"""Compares a network as it was read with the runtime that executes its file."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator

import numpy as np
import torch
from torch import Tensor

from ns_abstract.io.errors import InputError
from ns_abstract.verify.network.bounds import bound_outputs
from ns_abstract.verify.network.composite_activations import Quantised
from ns_abstract.verify.network.graph import Network
from ns_abstract.verify.network.image_sets import ImageSets
from ns_abstract.verify.network.layers import Activation
from ns_abstract.verify.network.scalar_function import ScalarFunction
from ns_abstract.verify.network.sparse_layers import Variance

#: One output, flattened, for one image [1, ...].
Evaluate = Callable[[np.ndarray], np.ndarray]
#: A reading that differs more than this, relative to the output, is wrong and not rounded,
_DIFFERENCE = 2.0**-10
#: unless float32 itself differs from float64 by so much: more than this part of it.
_ROUNDED = 64.0
#: or, for inputs that are not usual, than that and this.
_STRANGE = 2.0**-16
#: times this where values are rounded to steps.
_STEPPED = 2.0**6
#: Evaluations that tell how much an output is rounded, and what their images are moved by.
_EVALUATIONS, _MOVED = 3, 2.0**-22
#: Seconds and steps of the search for inputs that reach other sides of units; steps without a new one.
_SECONDS, _STEPS, _PATIENCE = 1.0, 24, 8
#: Outputs and units of networks whose bounds are worked out where numbers differ.
_BOUNDED, _UNITS = 32, 1 << 16


def levels(image: np.ndarray) -> np.ndarray:
    """Return the nearest whole numbers from 0 to 255, of the same type."""
    return np.clip(np.rint(image), 0.0, 255.0)


def compare(network: Network, run: Evaluate, images: Iterable[np.ndarray], *, usual: bool = True) -> None:
    """Raise InputError if the network as read and its file's runtime have different outputs for ``images`` [1, ...].

    ``usual``: whether outputs for these inputs must be finite.
    """
    path = network.source
    for image in images:
        image = (levels(image) if network.whole_numbers else image).astype(np.float32)
        try:
            expected = run(image).reshape(-1).astype(np.float64)
        except Exception as error:  # the other program's own
            raise InputError(f"cannot be run: {error}", file=path, fix="export the network again") from None
        with torch.no_grad():
            computed = network(torch.from_numpy(image).double())[0].numpy()
        if expected.shape != computed.shape:
            raise InputError(f"has {expected.size} outputs when run, {computed.size} when read", file=path)
        if not np.isfinite(expected).all() or not np.isfinite(computed).all():
            if not usual:
                continue
            raise InputError("computes numbers that are not finite", file=path, fix="train the network again")
        size = np.maximum(np.abs(expected), np.abs(computed))
        if any(isinstance(node.layer, Quantised) for node in network.nodes):
            # a rounding that falls the other way moves a value by a step
            size = np.full_like(size, _STEPPED * max(1.0 if usual else 0.0, size.max()))
        difference = np.abs(expected - computed)
        alike = difference <= _DIFFERENCE * np.maximum(size, 1.0 if usual else 0.0)
        if alike.all():
            continue
        if not usual and any(isinstance(node.layer, Variance) for node in network.nodes):
            # of features that are all alike programs find variances that differ by much, and bounds charge that
            continue
        if _within(network, image, expected):
            continue
        rounded = _rounded(network, image)
        wrong = ~(alike | (difference <= _ROUNDED * rounded + (0.0 if usual else _STRANGE))) & np.isfinite(rounded)
        if wrong.any():
            raise InputError(
                f"computes something else when run: outputs differ by {difference[wrong].max():.3g}",
                file=path,
                fix="export the network again in evaluation mode, or report the file",
            )


def _rounded(network: Network, image: np.ndarray) -> np.ndarray:
    """Return an estimate of each output's float32 error, from images near this one."""
    generator, off = np.random.default_rng(0), []
    for k in range(_EVALUATIONS):
        moved = image * (1.0 + _MOVED * generator.uniform(-1.0, 1.0, image.shape) * (k > 0))
        single = torch.from_numpy((levels(moved) if network.whole_numbers else moved).astype(np.float32))
        with torch.no_grad():
            off.append((network(single)[0].double() - network(single.double())[0]).abs().numpy())
    return np.max(off, axis=0)


def _within(network: Network, image: np.ndarray, expected: np.ndarray) -> bool:
    """Return whether the runtime's outputs lie within the network's bounds, which charge float32 rounding.

    Sums of computed constants may cancel, so that two programs differ by much.
    """
    units = sum(int(np.prod(node.layer.shape)) for node in network.nodes)
    if expected.size > _BOUNDED or units > _UNITS:
        return False
    flat = image.astype(np.float64).reshape(1, -1)
    still = np.zeros((1, flat.shape[1], 1))
    rows = np.concatenate([np.eye(expected.size), -np.eye(expected.size)])
    lower_bounds = bound_outputs(
        network, ImageSets(still, flat, still, flat, flat, flat), rows, np.zeros(len(rows))
    ).lower[0]
    low, high = lower_bounds[: expected.size], -lower_bounds[expected.size :]
    return bool(np.isfinite(lower_bounds).all() and (low <= expected).all() and (expected <= high).all())


def probes(network: Network) -> tuple[Iterator[np.ndarray], Iterator[np.ndarray]]:
    """Return usual test inputs, and unusual ones: corners, large and tiny numbers, and switched activation phases."""
    return _usual(network), _strange(network)


def _usual(network: Network) -> Iterator[np.ndarray]:
    generator = np.random.default_rng(0)
    top = 255.0 if network.whole_numbers else 1.0
    for k in range(3):
        yield generator.uniform(0.0, top * (1.0 + k), (1, *network.input_shape))


def _strange(network: Network) -> Iterator[np.ndarray]:
    generator = np.random.default_rng(1)
    shape, end = (1, *network.input_shape), time.monotonic() + _SECONDS
    sides = _VisitedPhases(network)
    fixed = [np.zeros(shape), np.ones(shape), -np.ones(shape)]
    fixed += [generator.normal(size=shape) * size for size in (1.0, 2.0**-60, 16.0, 256.0)]
    for image in fixed:
        if time.monotonic() > end:
            return
        sides.visit(torch.from_numpy(image))
        yield image
    image, step, idle = torch.from_numpy(generator.uniform(size=shape)), 0.5, 0
    for _ in range(_STEPS):
        if time.monotonic() > end or idle >= _PATIENCE:
            return
        moved = sides.gradient(image)
        if moved is None:
            return
        image = image + step * torch.sign(moved)
        new = sides.visit(image)
        idle, step = (0, step) if new else (idle + 1, 4.0 * step)
        yield image.numpy()


class _VisitedPhases:
    """Records the activation phases that test inputs have visited."""

    def __init__(self, network: Network) -> None:
        self.network = network
        #: by node and kink: units that have been below and above
        self.seen: dict[tuple[int, float], tuple[Tensor, Tensor]] = {}

    def _inputs(self, image: Tensor) -> Iterator[tuple[tuple[int, float], Tensor]]:
        """Yield the input of each activation less each of its kinks, with the activation and the kink."""
        values: list[Tensor] = [image]
        for k, node in enumerate(self.network.nodes, 1):
            inputs = [values[index] for index in node.inputs]
            values.append(node.layer(inputs))
            if isinstance(node.layer, Activation):
                kinks = node.layer.breaks if isinstance(node.layer, ScalarFunction) else (0.0,)
                for kink in kinks:
                    if np.isfinite(kink):
                        yield (k, kink), inputs[0] - kink

    def visit(self, image: Tensor) -> bool:
        """Record the phases at an image, and return whether any neuron is in one for the first time."""
        new = False
        with torch.no_grad():
            for key, z in self._inputs(image):
                below, above = self.seen.get(key, (torch.zeros_like(z, dtype=torch.bool),) * 2)
                now = below | (z < 0.0), above | (z > 0.0)
                new |= bool((now[0] ^ below).any()) or bool((now[1] ^ above).any())
                self.seen[key] = now
        return new

    def gradient(self, image: Tensor) -> Tensor | None:
        """Return the image's gradient towards phases that were not visited; None if all were."""
        image = image.clone().requires_grad_(True)
        wanted: list[Tensor] = []
        for key, z in self._inputs(image):
            below, above = self.seen[key]
            missing = (~above).to(z.dtype) - (~below).to(z.dtype)
            if bool((missing != 0.0).any()):
                wanted.append((missing * z / (1.0 + z.detach().abs())).sum())
        if not wanted:
            return None
        total = torch.stack(wanted).sum()
        if not total.requires_grad:
            return None
        (gradient,) = torch.autograd.grad(total, image)
        return torch.nan_to_num(gradient)
