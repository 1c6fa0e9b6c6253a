"""Describes a network's layers, the memory of a cell, and its time, measured on cells of a synthetic picture."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import torch

from ns_abstract.execution.cancellation import Deadline, WorkCancelledError
from ns_abstract.io.errors import InputError
from ns_abstract.verify.network.bounds import bound_outputs
from ns_abstract.verify.network.coefficients import grid
from ns_abstract.verify.network.cost_model import cost_model_of
from ns_abstract.verify.network.graph import Network, item
from ns_abstract.verify.network.image_sets import ImageSets
from ns_abstract.verify.network.layers import Convolution, LinearLayer, Matrix
from ns_abstract.verify.network.sparse_layers import SparseMatrix, TransposedConvolution

#: Numbers of float64 that every number of every layer takes in one cell, beside three for each parameter.
_NUMBERS = 8
#: Bytes of rows under way and of weights in other orders: of a network whose rows are few, and of a deep one.
_FEW_ROWS, _MANY_ROWS = 128 << 20, 420 << 20


@dataclass(frozen=True)
class MeasurementTuning:
    """How the time of a cell is measured.

    Attributes:
        motions: Largest motion of a picture's values in the measured cells; values are in [0, 1].
        rest: Uncertainty of a picture beside the motion, as a fraction of it; as in cells of splats.
        seconds: Time for all of them.
        brief: Cells up to this many seconds are bounded again, as the first time loads kernels.
        rows: Largest number of bounded outputs.
    """

    motions: tuple[float, ...] = (0.001, 0.01, 0.1)
    rest: float = 0.05
    seconds: float = 60.0
    brief: float = 2.0
    rows: int = 100


_TUNING = MeasurementTuning()


def multiplications(network: Network, index: int) -> float:
    """Return the number of multiplications in one evaluation of node ``index``."""
    layer = network.nodes[index - 1].layer
    size = float(np.prod(layer.shape))
    if isinstance(layer, Convolution):
        return size * float(np.prod(layer.weight.shape[1:]))
    if isinstance(layer, Matrix):
        return size * layer.weight.shape[1]
    if isinstance(layer, TransposedConvolution):
        return float(np.prod(layer.input_shapes[0])) * float(np.prod(layer.weight.shape[1:]))
    if isinstance(layer, SparseMatrix):
        return float(layer.weight.numel())
    return size


def cell_bytes(network: Network, dimensions: int) -> float:
    """Return the estimated bytes of one cell in ``dimensions`` parameters."""
    sizes = [float(np.prod(network.shape(k))) for k in range(len(network.nodes) + 1)]
    return sum(sizes) * 8 * (3 * dimensions + _NUMBERS) + (_MANY_ROWS if cost_model_of(network).deep else _FEW_ROWS)


def check_cell(
    network: Network, dimensions: int, allowed: float, remedy: str = "a larger --memory-limit, fewer --workers"
) -> None:
    """Raise InputError if one cell of the network is estimated to take more than ``allowed`` bytes.

    ``remedy`` names alternatives to a smaller network.
    """
    needed = cell_bytes(network, dimensions)
    if needed > allowed:
        raise InputError(
            f"needs about {needed / 2**30:.1f} GiB for a cell in {dimensions} parameters "
            f"({network.neuron_count:,} numbers), {allowed / 2**30:.1f} GiB are allowed",
            file=network.source,
            fix=f"give {remedy}, or a smaller network or image",
        )


def moving_picture(shape: tuple[int, ...], dimensions: int, motion: float) -> ImageSets:
    """Return one cell of a smooth picture of ``shape`` whose values move smoothly by at most ``motion``."""
    channels, height, width = grid(shape)
    channel, y, x = np.meshgrid(
        np.arange(channels), np.linspace(0.0, 1.0, height), np.linspace(0.0, 1.0, width), indexing="ij"
    )
    middle = (0.5 + 0.3 * np.sin(6.0 * x + channel) * np.cos(5.0 * y)).reshape(1, -1)
    along = [np.sin((k + 2.0) * (x + (k % 3) * y) + channel).reshape(1, -1) for k in range(dimensions)]
    slopes = np.stack(along, axis=-1) * (motion / dimensions) if along else np.zeros((1, middle.size, 0))
    room = np.full(middle.shape, motion * (_TUNING.rest if along else 1.0))
    reach = np.abs(slopes).sum(-1) + room
    return ImageSets(slopes, middle - room, slopes, middle + room, middle - reach, middle + reach)


def measured(network: Network, dimensions: int, seconds: float = _TUNING.seconds) -> Iterator[str]:
    """Yield lines of text on the time of cells of a moving picture, and the widths of the outputs' bounds there.

    After ``seconds`` the running cell is dropped and no wider one is begun.
    """
    count = min(network.output_size, 1 + _TUNING.rows)
    rows = np.eye(count, network.output_size)
    rows = np.concatenate([rows, -rows])
    deadline, threads = Deadline(seconds), torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for motion in _TUNING.motions:
            images, took = moving_picture(network.input_shape, dimensions, motion), None
            with suppress(WorkCancelledError), deadline.enforced():
                for _ in range(2):
                    begin = time.perf_counter()
                    low = bound_outputs(network, images, rows, np.zeros(len(rows))).lower[0]
                    took = min(time.perf_counter() - begin, np.inf if took is None else took)
                    if took > _TUNING.brief:
                        break
            if took is None:
                yield f"  values move by {motion:g}: not bounded within {seconds:g} s"
                return
            width = float((-low[:count] - low[count:]).max())
            yield f"  values move by {motion:g}: {took:.2g} s, outputs are bounded within {width:.3g}"
    finally:
        torch.set_num_threads(threads)


def explain(network: Network, dimensions: int = 2) -> Iterator[str]:
    """Yield lines of text: every layer with its size, the memory of one cell, and the time of cells (`measured`)."""
    yield f"{network.source}: {item(network.input_shape)} -> {item(network.output_shape)}"
    for k, node in enumerate(network.nodes, 1):
        kind = type(node.layer).__name__
        kind = "Reshape" if type(node.layer) is LinearLayer else kind
        inputs = ", ".join(map(str, node.inputs))
        yield f"{k:5d}  {kind:22s} {item(node.layer.shape):>14s}  of {inputs:12s} {node.op} {node.name}"
    work = sum(multiplications(network, k) for k in range(1, len(network.nodes) + 1))
    yield f"{len(network.nodes)} layers, {network.neuron_count:,} numbers, {work:,.0f} products an evaluation"
    memory = cell_bytes(network, dimensions)
    yield f"one cell in {dimensions} parameters: about {memory / 2**30:.2f} GiB; one core, smooth pictures in [0, 1]:"
    yield from measured(network, dimensions)
    if cost_model_of(network).planned:
        yield "deep: backward passes end on the way, where that leaves nothing known they are given up after seconds"
    yield from (line if line.startswith("not covered") else f"covered: {line}" for line in network.guarantee())
