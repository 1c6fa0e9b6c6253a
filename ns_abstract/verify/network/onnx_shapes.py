"""Rules of ONNX operators that rearrange, select, repeat or interpolate numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import onnx

from ns_abstract.io.errors import InputError
from ns_abstract.verify.network.contractions import concatenated
from ns_abstract.verify.network.graph import item
from ns_abstract.verify.network.interpolation import interpolation
from ns_abstract.verify.network.onnx_arithmetic import broadcast, contraction_operand, operand
from ns_abstract.verify.network.onnx_graph import Attributes, OnnxReader, Rule, TensorValue


def _places(r: OnnxReader, value: TensorValue) -> np.ndarray:
    """Return flat positions of the value's numbers, in its shape in the file."""
    return r.builder.positions(value.index).reshape(value.whole)


def _gathered(r: OnnxReader, node: onnx.NodeProto, value: TensorValue, places: np.ndarray, output: int = 0) -> None:
    """Set a node's output to the numbers of ``value`` at the flat positions ``places``, in their shape."""
    if places.size == 0:
        raise InputError(f"nothing is left of {item(value.whole)}", fix="check the constants")
    index = value.index
    if places.size != math.prod(value.whole) or not np.array_equal(places.reshape(-1), np.arange(places.size)):
        index = r.builder.gather(index, places.reshape(TensorValue(0, places.shape or (1,)).item))
    r.result(node, index, places.shape or (1,), output)


def _flatten(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x, axis = r.value(node), int(a.get("axis", 1))
    if not -len(x.whole) <= axis <= len(x.whole):
        raise InputError(f"attribute axis = {axis} of {item(x.whole)}", fix="use 1")
    axis = axis + len(x.whole) if axis < 0 else axis
    if r.batch > 1 and axis != 1:
        raise InputError(f"attribute axis = {axis} on a batch of {r.batch} items", fix="use 1")
    r.result(node, x.index, (math.prod(x.whole[:axis]), math.prod(x.whole[axis:])))


def _reshape(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.value(node)
    target = [int(v) for v in np.atleast_1d(r.weight(node, 1))]
    if 0 in target:
        # without a 0 in the shape, as the exporters write it, the attribute means nothing
        a.only("allowzero", 0)
    a.ignore("allowzero")
    for k, size in enumerate(target):
        if size == 0:
            if k >= len(x.whole):
                raise InputError(f"shape {target} copies a size that is not there", fix="check the shape")
            target[k] = x.whole[k]
    if r.batch > 1:
        if not x.batched or not target or target[0] not in (r.batch, -1):
            raise InputError(f"shape {target} mixes the {r.batch} items of a batch", fix="export with a batch of 1")
        target[0] = 1 if target[0] == r.batch else -1
    total, rest = math.prod(x.whole), math.prod(v for v in target if v != -1)
    if target.count(-1) > 1 or rest <= 0 or total % rest or (-1 not in target and rest != total):
        raise InputError(f"shape {target} of {total} numbers", fix="export with a batch of 1")
    r.result(node, x.index, tuple(total // rest if v == -1 else v for v in target))


def axes_of(r: OnnxReader, node: onnx.NodeProto, a: Attributes, rank: int) -> list[int] | None:
    """Return axes of the shape in the file, from an attribute or the second input; None if neither is there."""
    axes = a.get("axes")
    if axes is None:
        axes = r.constant(node, 1)
    if axes is None:
        return None
    chosen = [int(v) for v in np.atleast_1d(axes)]
    if any(not -rank <= v < rank for v in chosen) or len({v % rank for v in chosen}) != len(chosen):
        raise InputError(f"axes {chosen} of {rank}", fix="check the axes")
    return sorted(v % rank for v in chosen)


def _squeeze(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.value(node)
    axes = axes_of(r, node, a, len(x.whole))
    axes = [k for k, n in enumerate(x.whole) if n == 1] if axes is None else axes
    if any(x.whole[k] != 1 for k in axes):
        raise InputError(f"axes {axes} of {item(x.whole)} are not 1", fix="check the axes")
    r.result(node, x.index, tuple(n for k, n in enumerate(x.whole) if k not in axes) or (1,))


def _unsqueeze(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.value(node)
    named = a.get("axes")
    count = np.size(r.weight(node, 1) if named is None else named)
    shape = list(x.whole)
    for k in axes_of(r, node, a, len(shape) + count) or []:
        shape.insert(k, 1)
    r.result(node, x.index, tuple(shape))


def _transpose(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.value(node)
    rank = len(x.whole)
    order = [int(v) for v in a.get("perm", range(rank - 1, -1, -1))]
    if sorted(order) != list(range(rank)):
        raise InputError(f"attribute perm = {order} of {rank} axes", fix="check the axes")
    _gathered(r, node, x, _places(r, x).transpose(order))


def _pad(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.source(node)
    rank = 1 + len(r.builder.shape(x))
    mode, pads = a.get("mode", "constant"), a.get("pads")
    if pads is None:
        pads = r.weight(node, 1)
    value = a.get("value")
    if value is None:
        value = r.constant(node, 2, 0.0)
    pads = [int(v) for v in np.atleast_1d(pads)]
    axes = r.constant(node, 3)
    if axes is not None:
        axes = [int(v) for v in np.atleast_1d(axes)]
        if len(pads) != 2 * len(axes) or any(not -rank <= v < rank for v in axes):
            raise InputError(f"pads = {pads} of axes {axes}", fix="give two pads an axis")
        spread = [0] * (2 * rank)
        for k, axis in enumerate(axes):
            spread[axis % rank], spread[rank + axis % rank] = pads[k], pads[len(axes) + k]
        pads = spread
    if len(pads) != 2 * rank or pads[0] or pads[rank]:
        raise InputError(f"pads = {pads} is not supported", fix="give pads of every axis, none of the batch")
    before, after = pads[1:rank], pads[rank + 1 :]
    r.result(node, r.builder.pad(x, before, after, mode, float(np.asarray(value).reshape(-1)[0])))


def _concat(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    axis = a.get("axis")
    parts = [operand(r, node, k) for k in range(len(node.input))]
    wholes = [p.whole if isinstance(p, TensorValue) else p.shape for p in parts]
    rank = len(wholes[0])
    if axis is None or not -rank <= axis < rank:
        raise InputError(f"attribute axis = {axis} is not supported", fix="name an axis of the item")
    axis %= rank
    if any(len(w) != rank or w[:axis] + w[axis + 1 :] != wholes[0][:axis] + wholes[0][axis + 1 :] for w in wholes):
        raise InputError(f"shapes {[item(w) for w in wholes]} do not fit", fix="check the axis")
    values = [p for p in parts if isinstance(p, TensorValue)]
    if len(values) == len(parts) and axis > 0 and all(v.batched for v in values):
        r.result(node, r.builder.concat([v.index for v in values], axis - 1))
        return
    if axis == 0 and all(v.batched for v in values):
        raise InputError("attribute axis = 0 is not supported", fix="the batch, axis 0, must stay")
    r.result(node, *concatenated(r.builder, [contraction_operand(p) for p in parts], axis))


def _slice(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.value(node)
    starts, ends = a.get("starts"), a.get("ends")
    if starts is None:
        starts, ends = r.weight(node, 1), r.weight(node, 2)
    starts, ends = np.atleast_1d(starts), np.atleast_1d(ends)
    axes = a.get("axes")
    axes = np.atleast_1d(r.constant(node, 3, np.arange(len(starts))) if axes is None else axes)
    steps = np.atleast_1d(r.constant(node, 4, np.ones(len(starts), np.int64)))
    if not len(starts) == len(ends) == len(axes) == len(steps):
        raise InputError("starts, ends, axes and steps differ in length", fix="check the constants")
    rank = len(x.whole)
    chosen = [slice(None)] * rank
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        if not -rank <= axis < rank or step == 0:
            raise InputError(f"axis {axis} with step {step} of {item(x.whole)}", fix="check the constants")
        start, end, size = int(start), int(end), x.whole[int(axis)]
        if step < 0:
            # before the first number is None for Python, and far below for ONNX
            start, end = min(start, size - 1), None if end < -size else end
        chosen[int(axis)] = slice(start, end, int(step))
    if x.batched and len(range(1)[chosen[0]]) == 1:
        _part(r, node, x, chosen)
    else:
        _gathered(r, node, x, _places(r, x)[tuple(chosen)])


def _part(r: OnnxReader, node: onnx.NodeProto, x: TensorValue, chosen: Sequence[slice], output: int = 0) -> None:
    """Set a node's output to the slice ``chosen`` of an item."""
    if not x.batched:
        _gathered(r, node, x, _places(r, x)[tuple(chosen)], output)
        return
    index = r.builder.part(x.index, chosen[1:])
    r.result(node, index, (1, *r.builder.shape(index)), output)


def _split(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.value(node)
    axis, rank = int(a.get("axis", 0)), len(x.whole)
    if not -rank <= axis < rank:
        raise InputError(f"attribute axis = {axis} of {item(x.whole)}", fix="check the axis")
    axis %= rank
    sizes = a.get("split")
    if sizes is None:
        sizes = r.constant(node, 1)
    size, count = x.whole[axis], len(node.output)
    a.only("num_outputs", count)
    if sizes is None:
        each = -(-size // count)
        sizes = [each] * (count - 1) + [size - each * (count - 1)]
    sizes = [int(v) for v in np.atleast_1d(sizes)]
    if sum(sizes) != size or len(sizes) != count or min(sizes) < 1:
        raise InputError(f"split = {sizes} of {size}", fix="check the sizes")
    done = 0
    for output, length in enumerate(sizes):
        if node.output[output]:
            chosen = [slice(None)] * rank
            chosen[axis] = slice(done, done + length)
            _part(r, node, x, chosen, output)
        done += length


def _gather(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x, indices = r.value(node), np.asarray(r.weight(node, 1))
    axis, rank = int(a.get("axis", 0)), len(x.whole)
    if not -rank <= axis < rank:
        raise InputError(f"attribute axis = {axis} of {item(x.whole)}", fix="check the axis")
    size = x.whole[axis]
    if indices.dtype.kind not in "iu" or (indices.size and not (-size <= indices.min() and indices.max() < size)):
        raise InputError(f"indices do not lie in the {size} numbers of axis {axis}", fix="check the indices")
    r.builder.reserve(float(math.prod(x.whole)) / size * indices.size)
    _gathered(r, node, x, np.take(_places(r, x), indices, axis))


def _gather_nd(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x, indices = r.value(node), np.asarray(r.weight(node, 1))
    a.only("batch_dims", 0)
    count = indices.shape[-1] if indices.ndim else 0
    if not 1 <= count <= len(x.whole) or indices.dtype.kind not in "iu" or not indices.size:
        raise InputError(f"indices {item(indices.shape)} of {item(x.whole)}", fix="check the indices")
    sizes = np.array(x.whole[:count])
    if not bool(((-sizes <= indices) & (indices < sizes)).all()):
        raise InputError(f"indices do not lie in {item(x.whole[:count])}", fix="check the indices")
    r.builder.reserve(float(indices.size // count) * math.prod(x.whole[count:]))
    _gathered(r, node, x, _places(r, x)[tuple(np.moveaxis(indices, -1, 0))])


def _expand(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x, shape = r.value(node), [int(v) for v in np.atleast_1d(r.weight(node, 1))]
    index, whole = broadcast(r.builder, x, shape)
    r.result(node, index, whole)


def _tile(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x, repeats = r.value(node), [int(v) for v in np.atleast_1d(r.weight(node, 1))]
    r.builder.reserve(float(math.prod(x.whole)) * math.prod(float(max(0, v)) for v in repeats))
    _gathered(r, node, x, np.tile(_places(r, x), repeats))


def _depth_to_space(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.value(node)
    size, mode = int(a.get("blocksize", 0)), a.get("mode", "DCR")
    n, c, h, w = x.whole if len(x.whole) == 4 else (0, 0, 0, 0)
    if size < 1 or n != 1:
        raise InputError(f"attribute blocksize = {size} of {item(x.whole)}", fix="check the size")
    if node.op_type == "SpaceToDepth":
        if h % size or w % size:
            raise InputError(f"attribute blocksize = {size} of {item(x.whole)}", fix="it must divide the size")
        places = _places(r, x).reshape(n, c, h // size, size, w // size, size).transpose(0, 3, 5, 1, 2, 4)
        _gathered(r, node, x, places.reshape(n, c * size * size, h // size, w // size))
        return
    if c % (size * size) or mode not in ("DCR", "CRD"):
        raise InputError(f"attributes blocksize = {size}, mode = {mode} of {item(x.whole)}", fix="check the size")
    rest = c // (size * size)
    if mode == "DCR":
        places = _places(r, x).reshape(n, size, size, rest, h, w).transpose(0, 3, 4, 1, 5, 2)
    else:
        places = _places(r, x).reshape(n, rest, size, size, h, w).transpose(0, 1, 4, 2, 5, 3)
    _gathered(r, node, x, places.reshape(n, rest, h * size, w * size))


def _resize(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.source(node)
    shape = r.builder.shape(x)
    if len(shape) != 3:
        raise InputError(f"input {item(shape)}", fix="only maps of rows and columns are resized")
    mode = a.get("mode", "nearest")
    a.only("antialias", 0)
    a.only("keep_aspect_ratio_policy", "stretch")
    a.ignore("extrapolation_value")
    if mode not in ("nearest", "linear", "bilinear", "cubic"):
        raise InputError(f"attribute mode = {mode} is not supported", fix="use nearest, linear or cubic")
    if mode == "cubic":
        a.only("exclude_outside", 0)
    bend = float(a.get("cubic_coeff_a", -0.75))
    a.ignore("exclude_outside")
    axes = [int(v) for v in a.get("axes", range(4))]
    if not all(0 <= v < 4 for v in axes):
        # onnxruntime writes outside of its memory
        raise InputError(f"attribute axes = {axes} is not supported", fix="count axes from the first one")
    old = node.op_type == "Upsample" or r.opset < 11
    scales = a.get("scales")
    if scales is None:
        scales = r.constant(node, 1 if old else 2)
    sizes = None if old else r.constant(node, 3)
    coordinates = a.get("coordinate_transformation_mode", "asymmetric" if old else "half_pixel")
    nearest = a.get("nearest_mode", "floor" if old else "round_prefer_floor")
    whole: list[int] = [1, *shape]
    ratio: list[float | None] = [None] * 4
    out = list(whole)
    if sizes is not None and np.size(sizes):
        for axis, size in zip(axes, np.atleast_1d(sizes), strict=True):
            out[axis] = int(size)
    elif scales is not None and np.size(scales) == len(axes):
        for axis, scale in zip(axes, np.atleast_1d(scales), strict=True):
            if not 0.0 < float(scale) < 1024.0:
                raise InputError(f"scales {list(np.atleast_1d(scales))}", fix="positive numbers expected")
            out[axis], ratio[axis] = int(np.float32(whole[axis]) * np.float32(scale)), float(scale)
    else:
        raise InputError("neither scales nor sizes are given", fix="export with fixed sizes")
    if out[:2] != whole[:2] or min(out) < 1:
        raise InputError(f"resizes {item(whole)} to {item(out)}", fix="only rows and columns may change")
    if out == whole and any(v not in (None, 1.0) for v in ratio):
        # onnxruntime copies, the operator's definition does not
        raise InputError(f"scales of {item(whole)} that keep its size", fix="export with sizes, or without the node")
    r.builder.reserve(float(math.prod(out)) * 4.0)
    # before operator set 11 onnxruntime rounds places up where an axis shrinks
    picks = ["ceil" if old and (ratio[k] or 1.0) < 1.0 else nearest for k in (2, 3)]
    maps = [
        interpolation(whole[k], out[k], mode, coordinates, pick, ratio[k], bend)
        for k, pick in zip((2, 3), picks, strict=True)
    ]
    r.result(node, r.builder.resize(x, maps))


SHAPE_RULES: dict[str, Rule] = {
    "Concat": _concat,
    "DepthToSpace": _depth_to_space,
    "Expand": _expand,
    "Flatten": _flatten,
    "Gather": _gather,
    "GatherND": _gather_nd,
    "Pad": _pad,
    "Reshape": _reshape,
    "Resize": _resize,
    "Slice": _slice,
    "SpaceToDepth": _depth_to_space,
    "Split": _split,
    "Squeeze": _squeeze,
    "Tile": _tile,
    "Transpose": _transpose,
    "Unsqueeze": _unsqueeze,
    "Upsample": _resize,
}
