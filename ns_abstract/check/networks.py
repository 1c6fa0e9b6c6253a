"""Bounds of a network's outputs over pictures given as forms, in real numbers and for every float32 evaluation.

The forms' radii, and unstable ReLU neurons, get symbols of their own, which go through all layers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch.nn.functional import avg_pool2d, conv2d, pad

from ns_abstract.check.forms import Affine, Array, total

#: Bytes of a file that are read at most, and coefficients of a layer's symbols; part of the largest remainder that a
#: number has a symbol from.
_MOST_BYTES, _MOST_COEFFICIENTS, _PART = 1 << 30, 1 << 26, 1.0 / 64.0
#: Options of operators that are used, and values of others that change nothing.
_USED = ("pads", "strides", "dilations", "group", "kernel_shape", "transB", "count_include_pad")
_PLAIN = {"auto_pad": b"NOTSET", "alpha": 1.0, "beta": 1.0, "transA": 0, "ceil_mode": 0, "axis": 1}
#: What a node makes of the forms of its inputs.
_Step = Callable[..., Affine]


class CheckedNetwork(NamedTuple):
    """A network as a list of layers, each behind the layers that it takes inputs from."""

    #: Names of its inputs and its output, and what it makes of its inputs' forms.
    layers: list[tuple[list[str], str, _Step]]
    #: The names of its input and of the output that counts.
    source: str
    output: str
    #: Unit roundoff of its evaluation; 0: the network of real numbers.
    unit: float

    def outputs(self, picture: Affine, rows: Array | None = None) -> Affine:
        """Return the outputs [B, n] over pictures [B, ...], or ``rows`` [m, n] times the outputs, [B, m]."""
        boxes = (picture.apply(lambda a, k=k: a[..., k : k + 1, :, :, :]) for k in range(len(picture.c)))
        with np.errstate(all="ignore"):
            return Affine.joined([self._outputs(box, rows) for box in boxes], -2)

    def _outputs(self, picture: Affine, rows: Array | None) -> Affine:
        known = {self.source: _with_symbols(picture)}
        for inputs, output, step in self.layers:
            # a symbol is new to all that is known
            count = max(len(form.g) for form in known.values())
            known[output] = step(*(known[name].padded(count) for name in inputs))
        form = known[self.output].reshaped(1, known[self.output].c.size)
        form = form if rows is None else form.dense(rows, np.zeros(len(rows)))
        return form.keep_symbols(len(picture.g))


def _with_symbols(form: Affine) -> Affine:
    """Return the tensor of one picture with symbols in place of its largest radii."""
    flat = form.reshaped(1, form.c.size)
    return flat.with_symbols(_MOST_COEFFICIENTS // form.c.size, _PART).reshaped(*form.c.shape)


def read_network(file: Path, output: str | None, unit: float) -> CheckedNetwork:
    """Return the network in an .onnx file of convolutions, products, average pooling, ReLU and sums.

    ``output`` names the output that counts; None: the only one. ``unit`` is the unit roundoff of the network's
    evaluation. Raises ValueError where the file cannot be read or holds another operator.
    """
    import onnx

    if file.stat().st_size > _MOST_BYTES:
        raise ValueError("the network is too large")
    graph = (model := onnx.load(str(file))).graph
    # constants of halves would be evaluated in halves
    stored = [t for t in graph.initializer if t.data_type in (onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE)]
    read = {t.name: np.array(onnx.numpy_helper.to_array(t), np.float64) for t in stored}
    names = [o.name for o in graph.output]
    if (output is None and len(names) != 1) or output not in (None, *names):
        raise ValueError("the output is not said")
    source, layers, sums = next(i.name for i in graph.input if i.name not in read), [], [(1, 1.0)]
    made = {source}
    for node in graph.node:
        options = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
        constants = [read[name] for name in node.input if name in read]
        inputs = [name for name in node.input if name and name not in read]
        # runtimes may take the first of two, and a local function may have the name of any operator
        given, own = [a.name for a in node.attribute], node.domain in ("", "ai.onnx") and not model.functions
        wrong = [k for k, v in options.items() if given.count(k) > 1 or (k not in _USED and _PLAIN.get(k) != v)]
        if wrong or not own or not made.issuperset(inputs) or not inputs or list(node.input[: len(inputs)]) != inputs:
            raise ValueError(f"has {node.op_type} with {wrong or 'inputs or a domain'} that this program does not read")
        step = _layer(node.op_type, options, constants, len(inputs), unit, sums)
        layers.append((inputs, node.output[0], step))
        made.add(node.output[0])
    return CheckedNetwork(layers, source, output or names[0], unit)


def _layer(kind: str, options: dict[str, Any], constants: list[Array], inputs: int, unit: float, sums: Any) -> _Step:
    """Return the function from the forms of an operator's inputs to its output's; ``constants`` are stored inputs."""
    # ``sums`` are the numbers of terms and the largest coefficients of the network's sums; this one's are added

    def added(*parts: Affine) -> Affine:
        if len({part.c.ndim for part in parts}) > 1:
            raise ValueError("adds tensors of other dimensions")
        # a program may start a sum with what is added behind it, or fold that into the sums that follow
        longest, largest = (max(column) for column in zip(*sums, strict=True))
        shift, terms = constants[0] if constants else np.zeros(1), 3 * (longest + 9)
        return total(part.linear(np.array, np.array, shift, terms, unit, largest) for part in parts)

    match kind, inputs, [a.ndim for a in constants]:
        case "Relu", 1, []:
            return lambda x: _with_symbols(x.clamped(0.0, np.inf))
        case ("Add", 2, []) | ("Add", 1, [_]):
            return added
        case "Conv", 1, [4, *_]:
            weight, *rest = constants
            pads, bias = options.get("pads", [0] * 4), rest[0].reshape(-1, 1, 1) if rest else np.zeros(1)
            stride, dilation, groups = (options.get(name, 1) for name in ("strides", "dilations", "group"))
            spare = (pads[1], pads[3], pads[0], pads[2])

            def convolution(weight: Array) -> Callable[[Array], Array]:
                w = torch.from_numpy(weight)
                return _of_pictures(lambda x: conv2d(pad(x, spare), w, None, stride, 0, dilation, groups))

            f, size = convolution(weight), convolution(np.abs(weight))
            sums.append((weight[0].size, np.abs(weight).max()))
            return lambda x: x.linear(f, size, bias, weight[0].size, unit, np.abs(weight).max())
        case (("Gemm" | "MatMul"), 1, [2, *_]):
            weight = constants[0] if options.get("transB") else constants[0].T
            sums.append((weight.shape[1], np.abs(weight).max()))
            return lambda x: x.dense(weight, constants[1] if constants[1:] else np.zeros(1), unit)
        case "AveragePool", 1, [] if not any(options.get("pads", [])) and "dilations" not in options:
            kernel, stride = options["kernel_shape"], options.get("strides", 1)
            f = _of_pictures(lambda x: avg_pool2d(x, kernel, stride))
            sums.append((math.prod(kernel), 1.0))
            return lambda x: x.linear(f, f, np.zeros(1), math.prod(kernel), unit)
        case "Flatten", 1, []:
            return lambda x: x.reshaped(1, x.c.size)
    raise ValueError(f"has an operator {kind} that this program does not read")


def _of_pictures(f: Callable[[torch.Tensor], torch.Tensor]) -> Callable[[Array], Array]:
    """Return a map of tensors [N, C, H, W] as a map of arrays [..., C, H, W]."""

    def mapped(a: Array) -> Array:
        lead, rest = a.shape[:-3], a.shape[-3:]
        maps = f(torch.from_numpy(np.array(a, np.float64).reshape(math.prod(lead), *rest))).numpy()
        return maps.reshape(*lead, *maps.shape[1:])

    return mapped
