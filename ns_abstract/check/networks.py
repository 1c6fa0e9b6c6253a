"""Bounds of a network's outputs over sets of pictures, which are forms: in real numbers and every float32 evaluation.

Layers are sums of products. One of k terms, computed in any order, errs by k + 2 roundings of the sum of the terms'
sizes; ``size`` holds that sum, and a layer's ``charge`` the roundings of this program and of the network itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ns_abstract.check.forms import Affine, U

#: Bytes of a file that are read, and neurons of a layer that are bounded again, at most.
_MOST_BYTES, _MOST_ROWS = 1 << 30, 4096
_NONE = torch.zeros(1, dtype=torch.float64)
#: Options of operators that are used, and values of others that change nothing.
_USED = ("pads", "strides", "dilations", "group", "kernel_shape", "transB", "count_include_pad")
_PLAIN = {"auto_pad": b"NOTSET", "alpha": 1.0, "beta": 1.0, "transA": 0, "ceil_mode": 0, "axis": 1}


class CheckedLayer(NamedTuple):
    """A node: its inputs and output; ``map`` is linear but for ``bias``, or a ReLU (None), or a sum of its inputs.

    ``absolute`` is the map of absolute weights, ``terms`` the number of products in a sum.
    """

    inputs: list[str]
    output: str
    map: Callable[[Tensor], Tensor] | None = None
    absolute: Callable[[Tensor], Tensor] | None = None
    bias: Tensor = _NONE
    terms: int = 0


class _Known(NamedTuple):
    """A tensor over B pictures: centres [B, ...], slopes [d, B, ...], errors, and sizes of the sums that made it."""

    c: Tensor
    g: Tensor
    r: Tensor
    size: Tensor

    def ends(self) -> tuple[Tensor, Tensor]:
        width = (self.g.abs().sum(0) + self.r) * (1.0 + 32.0 * U) + 4.0 * U * self.c.abs()
        return self.c - width, self.c + width


class CheckedNetwork:
    """A network of layers, each behind those that it needs.

    Args:
        layers: As they are computed.
        source: Name of the input.
        output: Name of the output that counts.
        unit: Unit roundoff of the network's own evaluation; 0: the network of real numbers.
    """

    def __init__(self, layers: list[CheckedLayer], source: str, output: str, unit: float) -> None:
        self.layers, self.input, self.output, self.unit = layers, source, output, unit

    def _charge(self, layer: CheckedLayer, shape: Any) -> float:
        own = (layer.terms + 4.0) * self.unit if layer.terms else 0.0
        return own + 4.0 * U * (math.prod(shape[1:]) + 2.0 * layer.terms + 32.0)

    def outputs(self, picture: Affine, rows: Tensor | None = None) -> Affine:
        """The outputs as forms [B, n] over pictures [B, ...]; or ``rows`` [m, n] times them, [B, m].

        Tensors are bounded from the picture on; neurons that may bend are bounded again by rows that go back to it.
        """
        c, g, r = (torch.from_numpy(np.ascontiguousarray(a, np.float64)) for a in (picture.c, picture.g, picture.r))
        relaxed, lines, deep = {self.input: _Known(c, g, r, c.abs() + g.abs().sum(0) + r)}, {}, set()
        for layer in self.layers:
            (c, g, r, size), *others = (relaxed[name] for name in layer.inputs)
            f, absolute = layer.map, layer.absolute
            if f is not None and absolute is not None:
                slopes = f(g.flatten(0, 1)) if len(g) else g.new_zeros(0)
                size = absolute(size) + layer.bias.abs()
                c, r = f(c) + layer.bias, absolute(r)
                g = slopes.reshape(len(g), *c.shape)
            elif others:
                c, g, r, size = (a + b for a, b in zip((c, g, r, size), others[0], strict=True))
            else:
                low, high = relaxed[layer.inputs[0]].ends()
                which, place = ((low < 0.0) & (high > 0.0)).flatten(1).nonzero().T
                if layer.inputs[0] in deep and 0 < len(which) <= _MOST_ROWS * len(c):
                    own = functional.one_hot(place, c[0].numel()).double()
                    least, most = map(torch.from_numpy, self._back(relaxed, lines, layer.inputs[0], own, which).range())
                    low.flatten(1)[which, place] = low.flatten(1)[which, place].maximum(least)
                    high.flatten(1)[which, place] = high.flatten(1)[which, place].minimum(most)
                slope, half = lines[layer.output] = _line(low, high)
                c, g, r, size = slope * c + half, slope * g, slope * r + half, torch.maximum(high, -low).clamp(min=0.0)
            r = (r + self._charge(layer, c.shape) * size) * (1.0 + 8.0 * U)
            relaxed[layer.output] = _Known(c, g, r, size)
            # what lies behind a ReLU: before the first one rows say no more than this
            deep |= {layer.output} if layer.output in lines or deep.intersection(layer.inputs) else set()
        count, size = len(picture.c), relaxed[self.output].c[0].numel()
        rows = torch.eye(size, dtype=torch.float64) if rows is None else rows
        which, m = torch.arange(count).repeat_interleave(len(rows)), len(rows)
        form = self._back(relaxed, lines, self.output, rows.repeat(count, 1), which)
        return form.of(lambda a: a.reshape(*a.shape[:-1], count, m))

    def _back(self, known: dict[str, _Known], lines: dict[str, Any], name: str, rows: Tensor, which: Tensor) -> Affine:
        """Forms [W] of ``rows`` [W, n] times a tensor of the pictures ``which`` [W]: rows go back to the picture.

        A ReLU lies between two parallel lines.
        """
        back = {name: rows.reshape(-1, *known[name].c.shape[1:])}
        c = r = torch.zeros(len(rows), dtype=torch.float64)

        def against(row: Tensor, values: Tensor) -> Tensor:
            return (row * values[which]).flatten(1).sum(1)

        for layer in reversed(self.layers):
            row = back.pop(layer.output, None)
            if row is None:
                continue
            size = known[layer.output].size
            r = r + self._charge(layer, size.shape) * against(row.abs(), size)
            if layer.map is not None:
                c = c + (row * layer.bias).flatten(1).sum(1)
                shape = known[layer.inputs[0]].c.shape[1:]
                place = torch.zeros(len(row), *shape, dtype=torch.float64, requires_grad=True)
                (row,) = torch.autograd.grad(layer.map(place), place, row)
            elif len(layer.inputs) == 1:
                slope, half = lines[layer.output]
                c, r, row = c + against(row, half), r + against(row.abs(), half), row * slope[which]
            for source in layer.inputs:
                back[source] = back[source] + row if source in back else row
        row, (pc, pg, pr, size) = back[self.input], known[self.input]
        c, g = c + against(row, pc), [against(row, part) for part in pg]
        rounding = 4.0 * U * (math.prod(size.shape[1:]) + len(pg) + 32.0)
        r = (r + against(row.abs(), pr + rounding * size)) * (1.0 + 1e-10) + 1e-30
        return Affine(c.numpy(), torch.stack(g).numpy() if g else np.zeros((0, len(rows))), r.numpy())


def _line(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Slope of the line in the middle of a ReLU of [low, high], and its height at 0, which is the most it errs by."""
    bends = (low < 0.0) & (high > 0.0)
    slope = torch.where(bends, high / (high - low).clamp(min=1e-300) * (1.0 + 8.0 * U), (low >= 0.0).double())
    slope, half = slope.clamp(max=1.0), torch.where(bends, -0.5 * slope.clamp(max=1.0) * low * (1.0 + 8.0 * U), 0.0)
    # what is not a number is not known
    return slope, torch.where(low <= high, half, torch.inf)


def read_network(file: Path, output: str | None, unit: float) -> CheckedNetwork:
    """A network of convolutions, products, average pooling, ReLU and sums from an .onnx file.

    Args:
        file: Where it lies.
        output: The output that counts; None: the only one.
        unit: As `CheckedNetwork`'s.

    Raises:
        ValueError: It cannot be read, or holds another operator.
    """
    import onnx

    if file.stat().st_size > _MOST_BYTES:
        raise ValueError("the network is too large")
    graph = onnx.load(str(file)).graph
    read = {t.name: torch.from_numpy(np.array(onnx.numpy_helper.to_array(t))).double() for t in graph.initializer}
    names = [o.name for o in graph.output]
    if (output is None and len(names) != 1) or output not in (None, *names):
        raise ValueError("the output is not said")
    source, layers = next(i.name for i in graph.input if i.name not in read), []
    made = {source}
    for node in graph.node:
        options = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
        constants = [read[name] for name in node.input if name in read]
        inputs = [name for name in node.input if name and name not in read]
        wrong = [k for k, v in options.items() if k not in _USED and _PLAIN.get(k) != v]
        if wrong or not made.issuperset(inputs) or not inputs or list(node.input[: len(inputs)]) != inputs:
            raise ValueError(f"has {node.op_type} with {wrong or 'inputs'} that this program does not read")
        layers.append(CheckedLayer(inputs, node.output[0], *_layer(node.op_type, options, constants, len(inputs))))
        made.add(node.output[0])
    return CheckedNetwork(layers, source, output or names[0], unit)


def _layer(kind: str, options: dict[str, Any], constants: list[Tensor], inputs: int) -> tuple[Any, ...]:
    """Map, map of absolute weights, bias and number of terms; sums and ReLU have no map.

    The operator's inputs are ``inputs`` others, then ``constants``.
    """
    pads = options.get("pads", [0] * 4)
    if (kind, inputs, len(constants)) in (("Relu", 1, 0), ("Add", 2, 0)):
        return None, None, _NONE, int(kind == "Add")
    if (kind, inputs, len(constants)) == ("Add", 1, 1):
        return (lambda x: x), (lambda x: x), constants[0], 1
    if kind == "Conv" and inputs == 1 and constants[0].ndim == 4:
        weight, *rest = constants
        stride, dilation, groups = (options.get(name, 1) for name in ("strides", "dilations", "group"))
        spare = (pads[1], pads[3], pads[0], pads[2])
        f, size = (
            lambda x, w=w: functional.conv2d(functional.pad(x, spare), w, None, stride, 0, dilation, groups)
            for w in (weight, weight.abs())
        )
        bias = rest[0].reshape(-1, 1, 1) if rest else _NONE
        return f, size, bias, weight[0].numel() + weight.numel() // weight.shape[1]
    if kind in ("Gemm", "MatMul") and inputs == 1 and constants[0].ndim == 2:
        weight = constants[0] if options.get("transB") else constants[0].T
        f, size = (lambda x, w=w: x @ w.T for w in (weight, weight.abs()))
        return f, size, (constants[1:] or [_NONE])[0], sum(weight.shape)
    if kind == "AveragePool" and not any(pads) and "dilations" not in options:
        kernel, stride = options["kernel_shape"], options.get("strides", 1)
        f = lambda x: functional.avg_pool2d(x, kernel, stride)  # noqa: E731
        return f, f, _NONE, math.prod(kernel) + 4
    if kind == "Flatten":
        return (lambda x: x.flatten(1)), (lambda x: x.flatten(1)), _NONE, 0
    raise ValueError(f"has an operator {kind} that this program does not read")
