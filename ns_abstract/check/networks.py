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
_MOST_BYTES, MOST_ROWS = 1 << 30, 4096


class CheckedLayer(NamedTuple):
    """A node: its inputs and output; ``map`` is linear but for ``bias``, or a ReLU (None), or a sum of its inputs.

    ``absolute`` is the map of absolute weights, ``terms`` the number of products in a sum.
    """

    inputs: list[str]
    output: str
    map: Callable[[Tensor], Tensor] | None
    absolute: Callable[[Tensor], Tensor] | None
    bias: Tensor
    terms: int


class NodeBounds(NamedTuple):
    """A tensor over B pictures: centres [B, ...], slopes [d, B, ...], errors, and sizes of the sums that made it."""

    c: Tensor
    g: Tensor
    r: Tensor
    size: Tensor

    def ends(self) -> tuple[Tensor, Tensor]:
        """Lower and upper bounds."""
        width = (self.g.abs().sum(0) + self.r) * (1.0 + 32.0 * U) + 4.0 * U * self.c.abs()
        return self.c - width, self.c + width


class CheckedNetwork:
    """A network of an .onnx file.

    Args:
        file: Of convolutions, products, average pooling, ReLU, sums and changes of shape.
        output: The output that counts; None: the only one.
        unit: Unit roundoff of the network's own evaluation; 0: the network of real numbers.

    Raises:
        ValueError: It cannot be read, or holds another operator.
    """

    def __init__(self, file: Path, output: str | None, unit: float) -> None:
        import onnx

        if file.stat().st_size > _MOST_BYTES:
            raise ValueError("the network is too large")
        graph = onnx.load(str(file)).graph
        read = {t.name: torch.from_numpy(np.array(onnx.numpy_helper.to_array(t))) for t in graph.initializer}
        names = [o.name for o in graph.output]
        if (output is None and len(names) != 1) or output not in (None, *names):
            raise ValueError("the output is not said")
        self.input = next(i.name for i in graph.input if i.name not in read)
        self.output, self.unit = output or names[0], unit
        self.layers: list[CheckedLayer] = []
        for node in graph.node:
            options = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
            if node.op_type == "Constant":
                read[node.output[0]] = torch.from_numpy(np.array(onnx.numpy_helper.to_array(options["value"])))
                continue
            constants = [read[name] for name in node.input if name in read]
            inputs = [name for name in node.input if name and name not in read]
            f, size, bias, terms = _layer(node.op_type, options, constants, len(inputs), node.input[0] in read)
            self.layers.append(CheckedLayer(inputs, node.output[0], f, size, bias, terms))

    def _charge(self, layer: CheckedLayer, shape: Any) -> float:
        own = (layer.terms + 4.0) * self.unit if layer.terms else 0.0
        return own + 4.0 * U * (math.prod(shape[1:]) + 2.0 * layer.terms + 32.0)

    def forward(self, picture: Affine, closely: bool = True) -> tuple[dict[str, NodeBounds], dict[str, Any]]:
        """What is known of all tensors over pictures [B, C, H, W], and the ends of ReLUs' inputs.

        Args:
            picture: Forms.
            closely: Whether neurons that may bend are bounded again by rows that go back to the picture.
        """
        c, g, r = (torch.from_numpy(np.ascontiguousarray(a, np.float64)) for a in (picture.c, picture.g, picture.r))
        known, ends = {self.input: NodeBounds(c, g, r, c.abs() + g.abs().sum(0) + r)}, {}
        for layer in self.layers:
            (c, g, r, size), *others = (known[name] for name in layer.inputs)
            f, absolute = layer.map, layer.absolute
            if f is not None and absolute is not None:
                slopes = f(g.flatten(0, 1)) if len(g) else g.new_zeros(0)
                size = absolute(size) + layer.bias.abs()
                c, r = f(c) + layer.bias, absolute(r)
                g = slopes.reshape(len(g), *c.shape)
            elif others:
                (c2, g2, r2, size2), *_ = others
                c, g, r, size = c + c2, g + g2, r + r2, size + size2
            else:
                low, high = known[layer.inputs[0]].ends()
                bends = ((low < 0.0) & (high > 0.0)).flatten(1).any(0).nonzero()[:, 0]
                if closely and 0 < len(bends) <= MOST_ROWS:
                    rows = torch.zeros(len(bends), c[0].numel(), dtype=torch.float64)
                    rows[torch.arange(len(bends)), bends] = 1.0
                    for values, sign, pick in ((low, 1.0, torch.maximum), (high, -1.0, torch.minimum)):
                        found = sign * self._back(known, ends, layer.inputs[0], sign * rows)
                        values.flatten(1)[:, bends] = pick(values.flatten(1)[:, bends], found)
                ends[layer.output] = low, high
                above, _, lift = _lines(low, high)
                half = 0.5 * lift
                c, g, r, size = above * c + half, above * g, above * r + half, torch.maximum(high, -low).clamp(min=0.0)
            r = (r + self._charge(layer, c.shape) * size) * (1.0 + 8.0 * U)
            known[layer.output] = NodeBounds(c, g, r, size)
        return known, ends

    def outputs(self, picture: Affine) -> Affine:
        """The outputs [B, n] as forms."""
        c, g, r, _ = self.forward(picture)[0][self.output]
        return Affine(c.flatten(1).numpy(), g.flatten(2).numpy(), r.flatten(1).numpy())

    def least(self, picture: Affine, rows: Tensor) -> Tensor:
        """Lower bounds [B, m] of ``rows`` [m, n] times the outputs over pictures [B, C, H, W]."""
        return self._back(*self.forward(picture), self.output, rows)

    def _back(self, known: dict[str, NodeBounds], ends: dict[str, Any], name: str, rows: Tensor) -> Tensor:
        """Lower bounds [B, m] of ``rows`` [m, n] times a tensor.

        Rows go back through the layers; a ReLU is replaced by a line below or above it, as the row's sign asks.
        """
        shape = known[name].c.shape
        count, m = shape[0], len(rows)
        back = {name: rows.reshape(1, m, *shape[1:]).expand(count, m, *shape[1:])}
        bound = torch.zeros(count, m, dtype=torch.float64)

        def against(row: Tensor, values: Tensor) -> Tensor:
            return (row * values[:, None]).flatten(2).sum(2)

        for layer in reversed(self.layers):
            row = back.pop(layer.output, None)
            if row is None:
                continue
            size = known[layer.output].size
            bound = bound - self._charge(layer, size.shape) * against(row.abs(), size)
            before, f = known[layer.inputs[0]].c.shape[1:], layer.map
            if f is not None:
                bound = bound + (row * layer.bias).flatten(2).sum(2)
                place = torch.zeros(count * m, *before, dtype=torch.float64, requires_grad=True)
                (row,) = torch.autograd.grad(f(place), place, row.flatten(0, 1))
                row = row.reshape(count, m, *before)
            elif len(layer.inputs) == 1:
                above, below, lift = _lines(*ends[layer.output])
                bound = bound + against(row.clamp(max=0.0), lift)
                row = row * torch.where(row > 0.0, below[:, None], above[:, None])
            for source in layer.inputs:
                back[source] = back[source] + row if source in back else row
        row, (c, g, r, size) = back[self.input], known[self.input]
        slopes = sum((against(row, part).abs() for part in g), torch.zeros_like(bound))
        rounding = 4.0 * U * (math.prod(size.shape[1:]) + len(g) + 32.0)
        return bound + against(row, c) - slopes - against(row.abs(), r + rounding * size) - 1e-30


def _lines(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Slopes of lines above and below a ReLU of [low, high], and by how much the upper one is lifted."""
    bends = (low < 0.0) & (high > 0.0)
    above = torch.where(bends, high / (high - low).clamp(min=1e-300) * (1.0 + 8.0 * U), (low >= 0.0).double())
    above = above.clamp(max=1.0)
    below = torch.where(bends, (high > -low).double(), (low >= 0.0).double())
    return above, below, torch.where(bends, -above * low * (1.0 + 8.0 * U), 0.0)


def _layer(kind: str, options: dict[str, Any], constants: list[Tensor], inputs: int, first: bool) -> Any:
    """Map, map of absolute weights, bias and number of terms of an operator; sums and ReLU have no map.

    Its inputs are ``constants`` and ``inputs`` others; ``first``: the first one is a constant.
    """
    none = torch.zeros(1, dtype=torch.float64)
    values = [v.double() for v in constants if v.is_floating_point()]
    if kind == "Relu" and inputs == 1:
        return None, None, none, 0
    if kind == "Add" and inputs == 2:
        return None, None, none, 1
    if kind == "Add" and inputs == 1:
        return (lambda x: x), (lambda x: x), values[0], 1
    if kind == "Conv" and options.get("auto_pad", b"NOTSET") == b"NOTSET" and inputs == 1 and values[0].ndim == 4:
        weight, *rest = values
        top, left, bottom, right = options.get("pads", [0] * 4)
        more = {"stride": options.get("strides", 1), "dilation": options.get("dilations", 1)}
        more["groups"] = options.get("group", 1)
        f, size = (
            lambda x, w=w: functional.conv2d(functional.pad(x, (left, right, top, bottom)), w, **more)
            for w in (weight, weight.abs())
        )
        bias = rest[0].reshape(-1, 1, 1) if rest else none
        return f, size, bias, weight[0].numel() + weight.numel() // weight.shape[1]
    if kind in ("Gemm", "MatMul") and inputs == 1 and not first and not options.get("transA"):
        weight = values[0].T if options.get("transB") else values[0]
        if options.get("alpha", 1.0) != 1.0 or options.get("beta", 1.0) != 1.0 or weight.ndim != 2:
            raise ValueError(f"has scaled products ({kind}), which this program does not read")
        return (lambda x: x @ weight), (lambda x: x @ weight.abs()), (values[1:] or [none])[0], sum(weight.shape)
    if kind == "AveragePool" and not options.get("ceil_mode") and not any(options.get("pads", [0])):
        kernel, stride = options["kernel_shape"], options.get("strides", 1)
        f = lambda x: functional.avg_pool2d(x, kernel, stride)  # noqa: E731
        return f, f, none, math.prod(kernel) + 4
    if kind == "Pad" and options.get("mode", b"constant") == b"constant" and not any(float(v) for v in values[:1]):
        pads = [int(v) for v in (options.get("pads") or next(c for c in constants if not c.is_floating_point()))]
        if len(pads) == 8 and not any(pads[k] for k in (0, 1, 4, 5)):
            f = lambda x: functional.pad(x, (pads[3], pads[7], pads[2], pads[6]))  # noqa: E731
            return f, f, none, 1
    if (kind == "Flatten" and options.get("axis", 1) == 1) or kind in ("Identity", "Reshape"):
        shape = [int(v) for v in constants[0].tolist()] if kind == "Reshape" else [0, -1]
        if kind == "Identity":
            return (lambda x: x), (lambda x: x), none, 0
        if shape[0] in (0, 1, -1) and 0 not in shape[1:]:
            rest = shape[1:] if shape[0] != -1 or -1 not in shape[1:] else None
            if rest is not None and (shape[0] != -1 or all(v > 0 for v in rest)):
                f = lambda x: x.reshape(len(x), *rest)  # noqa: E731
                return f, f, none, 0
    raise ValueError(f"has an operator {kind} that this program does not read")
