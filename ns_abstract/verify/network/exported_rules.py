"""What the operators of torch's graphs are in layers."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from ns_abstract.arithmetic.network_charges import LEAST_DIVISOR
from ns_abstract.io.errors import InputError
from ns_abstract.verify.network import curves
from ns_abstract.verify.network.compose import Axis, Composer, interpolation
from ns_abstract.verify.network.exported_graph import Arguments, Index, Operators, Reader, Rule, named_values
from ns_abstract.verify.network.graph import item
from ns_abstract.verify.network.operands import einsum, joined, matmul
from ns_abstract.verify.network.recognised import SwitchedSoftplus

_ONES = (1, 1)


def _conv(r: Reader, a: Arguments) -> Index:
    x, weight, padding = a.image("input"), a.needed("weight"), a.get("padding", 0)
    if weight.ndim != 4 or len(r.builder.shape(x)) != 3 or isinstance(padding, str):
        raise InputError(f"weights {item(weight.shape)}", fix="only two-dimensional convolutions with numeric padding")
    pads = a.pair("padding", (0, 0)) * 2
    stride, dilation = a.pair("stride", _ONES), a.pair("dilation", _ONES)
    groups = int(a.get("groups", 1))
    return Index(r.builder.convolution(x, weight, a.array("bias"), stride, dilation, pads, groups))


def _linear(r: Reader, a: Arguments) -> Index:
    weight = a.needed("weight")
    x, whole = _image(a, "input")
    return Index(r.builder.matrix(x, weight, a.array("bias")), whole and (*whole[:-1], weight.shape[0]))


def _image(a: Arguments, name: str) -> tuple[int, tuple[int, ...] | None]:
    """A node that may have the batch inside its shape."""
    value = a.get(name)
    return (value.number, value.whole) if isinstance(value, Index) else (a.image(name), None)


def _batch_norm(r: Reader, a: Arguments) -> Index:
    x = a.image("input")
    a.only("training", False)
    a.ignore("momentum", "cudnn_enabled")
    mean, variance = a.needed("running_mean"), a.needed("running_var")
    scale, shift = a.array("weight"), a.array("bias")
    scale, shift = np.ones_like(mean) if scale is None else scale, np.zeros_like(mean) if shift is None else shift
    return Index(r.builder.batch_norm(x, scale, shift, mean, variance, float(a.get("eps", 1e-5))))


def _unary(make: Callable[[Composer, int, Arguments], int], name: str = "self") -> Rule:
    """A function of every number."""

    def rule(r: Reader, a: Arguments) -> Index:
        x, whole = _image(a, name)
        return Index(make(r.builder, x, a), whole)

    return rule


def _curve(kind: Callable[..., curves.Curve]) -> Rule:
    return _unary(lambda b, x, a: b.curve(x, kind))


def _number(a: Arguments, name: str, default: float) -> float:
    value = a.get(name)
    return default if value is None else float(np.asarray(value, np.float64).reshape(-1)[0])


def _positive(a: Arguments, name: str, default: float) -> float:
    value = _number(a, name, default)
    if not LEAST_DIVISOR < value < 2.0**20:
        raise InputError(f"argument {name} = {value} is not supported", fix="between 1e-30 and 1e6 expected")
    return value


def _elu(b: Composer, x: int, a: Arguments) -> int:
    a.only("input_scale", 1, 1.0)
    return b.curve(x, curves.Elu, alpha=_positive(a, "alpha", 1.0), scale=_positive(a, "scale", 1.0))


def _selu(b: Composer, x: int, a: Arguments) -> int:
    return b.curve(x, curves.Elu, alpha=1.6732632423543772, scale=1.0507009873554805)


def _celu(b: Composer, x: int, a: Arguments) -> int:
    alpha = _positive(a, "alpha", 1.0)
    return b.curve(x, curves.Elu, alpha=alpha, width=alpha)


def _gelu(b: Composer, x: int, a: Arguments) -> int:
    a.only("approximate", "none", "tanh")
    return b.curve(x, curves.GeluTanh if a.get("approximate", "none") == "tanh" else curves.Gelu)


def _softplus(b: Composer, x: int, a: Arguments) -> int:
    a.only("beta", 1, 1.0)
    limit = _number(a, "threshold", 20.0)
    if limit < 16.0:
        raise InputError("argument threshold is not supported", fix="at least 16")
    return b.curve(x, SwitchedSoftplus, limit=limit)


def _clamp(b: Composer, x: int, a: Arguments) -> int:
    low = [_number(a, name, -np.inf) for name in ("min", "min_val") if name in a.found]
    high = [_number(a, name, np.inf) for name in ("max", "max_val") if name in a.found]
    return b.clip(x, max(low, default=-np.inf), min(high, default=np.inf))


def _hardtanh(b: Composer, x: int, a: Arguments) -> int:
    return b.clip(x, _number(a, "min_val", -1.0), _number(a, "max_val", 1.0))


def _hard_sigmoid(b: Composer, x: int, a: Arguments) -> int:
    return b.curve(x, curves.Clip, factor=1.0 / 6.0, offset=0.5)


def _spread(b: Composer, x: int, constant: np.ndarray) -> int:
    """The value repeated to what a constant makes of it."""
    try:
        whole = np.broadcast_shapes((1, *b.shape(x)), constant.shape)
    except ValueError:
        raise InputError(f"constant {item(constant.shape)} with an item {item(b.shape(x))}") from None
    return b.spread(x, whole[1:])


def _sum(sign: int) -> Rule:
    def rule(r: Reader, a: Arguments) -> Index:
        a.only("alpha", 1)
        one, two = a.get("self"), a.get("other")
        if isinstance(one, Index) and isinstance(two, Index):
            if one.whole != two.whole:
                raise InputError("adds values with the batch in different places", fix="move the batch first")
            return Index(r.builder.plus((one.number, two.number), (1, sign)), one.whole)
        name, other, first = ("self", "other", 1) if isinstance(one, Index) else ("other", "self", sign)
        constant = a.needed(other)
        given, whole = _image(a, name)
        x = _spread(r.builder, given, constant)
        if whole is not None and r.builder.shape(x) != whole:
            raise InputError("is spread over a value with the batch inside its shape", fix="move the batch first")
        return Index(r.builder.scale(x, first * np.ones(()), constant * (sign if name == "self" else 1)), whole)

    return rule


def _expand(r: Reader, a: Arguments) -> Index:
    x, sizes = a.image("self"), [int(v) for v in a.get("size")]
    a.ignore("implicit")
    shape = r.builder.shape(x)
    if len(sizes) != 1 + len(shape) or sizes[0] not in (-1, 1, r.batch):
        raise InputError(f"argument size = {sizes} of an item {item(shape)}", fix="keep the batch and the axes")
    whole = tuple(n if size == -1 else size for n, size in zip(shape, sizes[1:], strict=True))
    if any(n not in (1, size) for n, size in zip(shape, whole, strict=True)):
        raise InputError(f"argument size = {sizes} of an item {item(shape)}", fix="only axes of 1 are repeated")
    return Index(r.builder.spread(x, whole))


def _log_sigmoid(b: Composer, x: int, a: Arguments) -> int:
    # log sigmoid z = -softplus(-z)
    minus = -np.ones(())
    return b.scale(b.curve(b.scale(x, minus, None), curves.Softplus), minus, None)


def _rsub(r: Reader, a: Arguments) -> Index:
    a.only("alpha", 1)
    return Index(r.builder.scale(a.image("self"), -np.ones(()), a.needed("other")))


def _mul(r: Reader, a: Arguments) -> Index:
    one, two = a.get("self"), a.get("other")
    if isinstance(one, Index) and isinstance(two, Index):
        return Index(r.builder.product(one.number, two.number))
    name, other = ("self", "other") if isinstance(one, Index) else ("other", "self")
    constant = a.needed(other)
    return Index(r.builder.scale(_spread(r.builder, a.image(name), constant), constant, None))


def _div(r: Reader, a: Arguments) -> Index:
    one, two = a.get("self"), a.get("other")
    if isinstance(two, Index):
        inverse = r.builder.reciprocal(two.number)
        if isinstance(one, Index):
            return Index(r.builder.product(one.number, inverse))
        return Index(r.builder.scale(inverse, a.needed("self"), None))
    divisor = a.needed("other")
    if not divisor.all():
        raise InputError("divides by zero", fix="check the constant")
    return Index(r.builder.scale(_spread(r.builder, a.image("self"), divisor), 1.0 / divisor, None))


def _pow(r: Reader, a: Arguments) -> Index:
    return Index(r.builder.power(a.image("self"), _number(a, "exponent", 1.0)))


def _prelu(r: Reader, a: Arguments) -> Index:
    x, slope = a.image("self"), a.needed("weight")
    return Index(r.builder.prelu(x, slope.reshape(-1, *[1] * (len(r.builder.shape(x)) - 1))))


def _extreme(most: bool) -> Rule:
    return lambda r, a: Index(r.builder.extreme((a.image("self"), a.image("other")), most))


def _inner(a: Arguments, name: str, rank: int) -> list[int]:
    """Axes of the item, none of them the batch."""
    found = a.get(name)
    values = [int(v) for v in np.atleast_1d(found if found is not None else [])]
    return sorted(_axis(v, rank) for v in values) or list(range(rank - 1))


def _reduced(kind: str) -> Rule:
    def rule(r: Reader, a: Arguments) -> Index:
        x = a.image("self")
        a.only("dtype", None)
        axes, keep = _inner(a, "dim", 1 + len(r.builder.shape(x))), bool(a.get("keepdim", False))
        if kind in ("mean", "sum"):
            return Index(r.builder.reduce(x, axes, kind == "mean", keep))
        return Index(r.builder.greatest(x, axes, keep, kind == "amax"))

    return rule


def _softmax(logarithm: bool) -> Rule:
    def rule(r: Reader, a: Arguments) -> Index:
        x = a.image("self")
        a.only("dtype", None)
        return Index(r.builder.softmax(x, _axis(int(a.get("dim")), 1 + len(r.builder.shape(x))), logarithm))

    return rule


def _layer_norm(r: Reader, a: Arguments) -> Index:
    (x, whole), count = _image(a, "input"), len(a.get("normalized_shape"))
    a.ignore("cudnn_enable")
    rank = len(r.builder.shape(x))
    index = r.builder.normalise(x, list(range(rank - count, rank)), float(a.get("eps", 1e-5)))
    weight = a.array("weight")
    index = index if weight is None else r.builder.scale(index, weight, None)
    return Index(r.builder.shift(index, a.array("bias")), whole)


def _group_norm(r: Reader, a: Arguments) -> Index:
    x = a.image("input")
    a.ignore("cudnn_enabled", "momentum", "running_mean", "running_var")
    a.only("use_input_stats", True)
    shape = r.builder.shape(x)
    groups = int(a.get("num_groups", shape[0]))
    if groups < 1 or shape[0] % groups:
        raise InputError(f"argument num_groups = {groups} of {shape[0]} channels", fix="it must divide them")
    split = (groups, shape[0] // groups, *shape[1:])
    index = r.builder.normalise(r.builder.reshape(x, split), list(range(1, len(split))), float(a.get("eps", 1e-5)))
    index, spread = r.builder.reshape(index, shape), (-1, *[1] * (len(shape) - 1))
    weight, bias = a.array("weight"), a.array("bias")
    index = index if weight is None else r.builder.scale(index, weight.reshape(spread), None)
    return Index(r.builder.shift(index, None if bias is None else bias.reshape(spread)))


#: What window operators along a line do across it.
_BESIDE = {"stride": 1, "padding": 0, "dilation": 1, "kernel_size": 1, "output_size": 1, "output_padding": 0}


def _whole(r: Reader, value: Any) -> tuple[Any, tuple[int, ...]]:
    """A node's number or a constant, and its shape in the file for a batch of 1."""
    if not isinstance(value, Index):
        found = np.asarray(value, np.float64)
        return found, found.shape
    return value.number, value.whole or (1, *r.builder.shape(value.number))


def _matmul(r: Reader, a: Arguments) -> Index:
    other = a.get("other" if "other" in a.found else "mat2")
    return _shaped(r, *matmul(r.builder, _whole(r, a.get("self")), _whole(r, other)))


def _apart(whole: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...] | None]:
    """The item of a shape in the file, and that shape where the batch is inside of it."""
    if not whole:
        raise InputError("leaves a number without an axis", fix="keep an axis")
    return (whole, whole) if len(whole) < 2 or whole[0] != 1 else (whole[1:], None)


def _shaped(r: Reader, index: int, whole: tuple[int, ...]) -> Index:
    """A node in its shape in the file."""
    shape, inside = _apart(whole)
    return Index(r.builder.reshape(index, shape), inside)


def _addmm(r: Reader, a: Arguments) -> Index:
    a.only("alpha", 1)
    a.only("beta", 1)
    return Index(r.builder.matrix(a.image("mat1"), a.needed("mat2").T, a.array("self")))


def _einsum(r: Reader, a: Arguments) -> Index:
    a.ignore("path")
    return _shaped(r, *einsum(r.builder, str(a.get("equation")), [_whole(r, v) for v in a.get("tensors")]))


def _attention(r: Reader, a: Arguments) -> Index:
    """``softmax(query key^T scale + mask) value`` as it is written; fused programs sum in other orders."""
    a.only("dropout_p", 0.0, 0)
    a.only("enable_gqa", False)
    b = r.builder
    query, key, value = (a.image(name) for name in ("query", "key", "value"))
    shape, other = b.shape(query), b.shape(key)
    scale, mask = a.get("scale"), a.get("attn_mask")
    factor = 1.0 / math.sqrt(shape[-1]) if scale is None else float(scale)
    rank = len(other)
    turned = b.transpose(key, [*range(rank - 2), rank - 1, rank - 2])
    scores = b.scale(b.matmul(query, turned), np.asarray(factor), None)
    if isinstance(mask, Index):
        raise InputError("argument attn_mask depends on the image", fix="it must be a constant")
    dropped = np.zeros(b.shape(scores), bool)
    if bool(a.get("is_causal", False)):
        dropped |= ~np.tri(*dropped.shape[-2:], dtype=bool)
    if mask is not None:
        given = np.asarray(mask)
        given = given.reshape(given.shape[given.ndim - min(given.ndim, dropped.ndim) :])
        if given.dtype == bool:
            dropped |= ~given
        else:
            dropped |= given == -np.inf
            scores = b.shift(scores, np.where(given == -np.inf, 0.0, given))
    shares = b.softmax(scores, len(shape) - 1, dropped=dropped if dropped.any() else None)
    return Index(b.matmul(shares, value))


def _stack(r: Reader, a: Arguments) -> Index:
    parts, axis = a.get("tensors"), int(a.get("dim", 0))
    rank = 1 + len(_whole(r, parts[0])[1])
    axis %= rank
    if axis == 0:
        raise InputError("stacks along the batch", fix="keep the batch first")
    raised: list[Any] = []
    for part in parts:
        value, whole = _whole(r, part)
        grown = (*whole[:axis], 1, *whole[axis:])
        raised.append(_shaped(r, value, grown) if isinstance(value, int) else value.reshape(grown))
    return _joined(r, raised, axis)


def _joined(r: Reader, parts: list[Any], axis: int) -> Index:
    """Values and constants one after another along an axis of the whole, not the batch."""
    if all(isinstance(part, Index) and part.whole is None for part in parts):
        return Index(r.builder.concat([part.number for part in parts], axis - 1))
    return _shaped(r, *joined(r.builder, [_whole(r, part) for part in parts], axis))


def _addcmul(r: Reader, a: Arguments) -> Index:
    """``self + value tensor1 tensor2`` with at most one factor that depends on the image."""
    one, two = a.get("tensor1"), a.get("tensor2")
    if isinstance(one, Index) and isinstance(two, Index):
        raise InputError("multiplies two values that depend on the image", fix="write the product out")
    name, other = ("tensor1", "tensor2") if isinstance(one, Index) else ("tensor2", "tensor1")
    b, base = r.builder, a.get("self")
    factor = a.needed(other) * _number(a, "value", 1.0)
    if not isinstance(a.get(name), Index):
        # both are constants
        offset = a.needed(name) * factor
        return Index(b.scale(_spread(b, a.image("self"), offset), np.ones(()), offset))
    moved = b.scale(_spread(b, a.image(name), factor), factor, None)
    if isinstance(base, Index):
        return Index(b.plus((a.image("self"), moved), (1, 1)))
    constant = a.needed("self")
    return Index(b.scale(_spread(b, moved, constant), np.ones(()), constant))


def _glu(r: Reader, a: Arguments) -> Index:
    x, b = a.image("self"), r.builder
    shape = b.shape(x)
    axis = _axis(int(a.get("dim", -1)), 1 + len(shape))
    if shape[axis] % 2:
        raise InputError(f"argument dim of {shape[axis]} numbers", fix="an even number expected")
    halves = []
    for first in (0, shape[axis] // 2):
        chosen = [slice(None)] * len(shape)
        chosen[axis] = slice(first, first + shape[axis] // 2)
        halves.append(b.part(x, chosen))
    return Index(b.product(halves[0], b.sigmoid(halves[1])))


def _softshrink(b: Composer, x: int, a: Arguments) -> int:
    limit = _number(a, "lambd", 0.5)
    return b.plus((x, b.clip(x, -limit, limit)), (1, -1))


def _threshold(b: Composer, x: int, a: Arguments) -> int:
    if _number(a, "threshold", 0.0) != _number(a, "value", 0.0):
        raise InputError("jumps at the threshold", fix="value and threshold must be alike")
    return b.clip(x, _number(a, "threshold", 0.0), np.inf)


def _vector_norm(r: Reader, a: Arguments) -> Index:
    x, b, power = a.image("self"), r.builder, _number(a, "ord", 2.0)
    a.only("dtype", None)
    axes, keep = _inner(a, "dim", 1 + len(b.shape(x))), bool(a.get("keepdim", False))
    if power == 1.0:
        return Index(b.reduce(b.curve(x, curves.Abs), axes, False, keep))
    if power != 2.0:
        raise InputError(f"argument ord = {power} is not supported", fix="1 or 2")
    return Index(b.power(b.reduce(b.power(x, 2.0), axes, False, keep), 0.5))


def _variance(root: bool) -> Rule:
    """Variance over axes of the item, or its root."""

    def rule(r: Reader, a: Arguments) -> Index:
        x, b = a.image("self"), r.builder
        shape = b.shape(x)
        axes, keep = _inner(a, "dim", 1 + len(shape)), bool(a.get("keepdim", False))
        correction = a.get("correction")
        less = (1 if a.get("unbiased", True) else 0) if correction is None else float(correction)
        count = math.prod(shape[k] for k in axes)
        if count <= less:
            raise InputError(f"divides by {count} - {less}", fix="give it more numbers")
        middle = b.reduce(x, axes, True, True)
        squares = b.power(b.plus((x, b.spread(middle, shape)), (1, -1)), 2.0)
        found = b.scale(b.reduce(squares, axes, True, keep), np.asarray(count / (count - less)), None)
        return Index(b.power(found, 0.5) if root else found)

    return rule


def _expand_as(r: Reader, a: Arguments) -> Index:
    _, shape = _whole(r, a.get("other"))
    return Index(r.builder.spread(a.image("self"), tuple(shape[1:])))


def _masked_fill(r: Reader, a: Arguments) -> Index:
    chosen, value = np.asarray(a.needed("mask"), bool), _number(a, "value", 0.0)
    if not math.isfinite(value):
        raise InputError(f"argument value = {value} is not supported", fix="use a finite number")
    x = _spread(r.builder, a.image("self"), chosen)
    return Index(r.builder.scale(x, (~chosen).astype(np.float64), np.where(chosen, value, 0.0)))


def _where(r: Reader, a: Arguments) -> Index:
    chosen, b = np.asarray(a.needed("condition"), bool), r.builder
    moving, offset = [], np.zeros(chosen.shape)
    for name, mask in (("self", chosen), ("other", ~chosen)):
        if isinstance(a.get(name), Index):
            moving.append(b.scale(_spread(b, a.image(name), mask), mask.astype(np.float64), None))
        else:
            offset = offset + np.where(mask, a.needed(name), 0.0)
    total = b.sum(tuple(moving), (1,) * len(moving), exact=True) if len(moving) > 1 else moving[0]
    return Index(b.scale(_spread(b, total, offset), np.ones(()), offset))


def _to(r: Reader, a: Arguments) -> Index:
    a.only("dtype", 7)
    a.ignore("non_blocking", "copy", "memory_format")
    return Index(*_image(a, "self"))


def _on_map(rule: Rule, *lines: str) -> Rule:
    """A rule for maps on values along a line [C, L], as maps of one column."""

    def found(r: Reader, a: Arguments) -> Index:
        x, b = a.image(lines[0]), r.builder
        shape = b.shape(x)
        if len(shape) != 2:
            raise InputError(f"input {item(shape)}", fix="channels along a line expected")
        a.found[lines[0]] = Index(b.reshape(x, (*shape, 1)))
        for name in lines[1:]:
            a.found[name] = a.needed(name)[..., None]
        for name, beside in _BESIDE.items():
            given = a.found.get(name)
            if given is not None and given != []:
                a.found[name] = [int(np.atleast_1d(given)[0]), beside]
        made = rule(r, a).number
        return Index(b.reshape(made, b.shape(made)[:2]))

    return found


def _average(size: int, out: int) -> Axis:
    """Means of adaptive windows."""
    rows = np.arange(out)[:, None]
    first, past = rows * size // out, -(-(rows + 1) * size // out)
    inside = (np.arange(size) >= first) & (np.arange(size) < past)
    return Axis(inside / (past - first), np.zeros((out, size)))


def _conv_transpose(r: Reader, a: Arguments) -> Index:
    x, weight = a.image("input"), a.needed("weight")
    pads, more = a.pair("padding", (0, 0)) * 2, a.pair("output_padding", (0, 0))
    stride, dilation = a.pair("stride", _ONES), a.pair("dilation", _ONES)
    groups = int(a.get("groups", 1))
    bias = a.array("bias")
    return Index(r.builder.transposed_convolution(x, weight, bias, stride, dilation, pads, more, groups))


def _upsample(mode: str) -> Rule:
    def rule(r: Reader, a: Arguments) -> Index:
        x = a.image("input")
        shape = r.builder.shape(x)
        align = bool(a.get("align_corners", False))
        sizes, scales = a.get("output_size"), a.get("scale_factors")
        if len(shape) != 3 or (sizes is None and scales is None):
            raise InputError(f"input {item(shape)}", fix="only maps of rows and columns are resized")
        ratios: list[Any] = [None, None] if scales is None else [float(v) for v in scales]
        found = [int(v) for v in sizes] if sizes else [int(n * f) for n, f in zip(shape[1:], ratios, strict=True)]
        r.builder.reserve(4.0 * shape[0] * found[0] * found[1])
        coordinates = "asymmetric" if mode == "nearest" else "align_corners" if align else "half_pixel"
        maps = [
            _nearest(n, m, ratio) if mode == "nearest" else interpolation(n, m, mode, coordinates, "floor", ratio)
            for n, m, ratio in zip(shape[1:], found, ratios, strict=True)
        ]
        return Index(r.builder.resize(x, maps))

    return rule


def _nearest(size: int, out: int, ratio: float | None) -> Axis:
    """The pixels that torch takes along one axis, which it is asked for: it computes their places in float32."""
    column = torch.arange(size, dtype=torch.float32).reshape(1, 1, size, 1)
    taken = torch.ops.aten.upsample_nearest2d(column, [out, 1], ratio, None).reshape(-1).long().numpy()
    matrix = np.zeros((out, size))
    matrix[np.arange(out), taken] = 1.0
    return Axis(matrix, np.zeros((out, size)))


def _moves(r: Reader, a: Arguments) -> Any:
    """An operator that moves, repeats and drops numbers: torch itself is asked where they go."""
    a.ignore(*a.found)
    moving = {name: v for name in _names(a.node) if isinstance(v := r.values.get(name), Index)}
    (name, value), *more = moving.items()
    if more:
        raise InputError("takes several values that depend on the image", fix="give one and constants")
    b = r.builder
    shape = (1, *b.shape(value.number)) if value.whole is None else value.whole
    # 0 is what torch puts between them
    found = r.by_torch(a.node, {name: 1.0 + b.positions(value.number).reshape(shape).astype(np.float64)})
    made = [_moved(r, value.number, part.numpy()) for part in (found if isinstance(found, (list, tuple)) else [found])]
    return made if isinstance(found, (list, tuple)) else made[0]


def _mixed(a: Arguments) -> bool:
    """Whether the value has the batch inside its shape."""
    return getattr(a.get("self"), "whole", None) is not None


def _names(node: dict[str, Any]) -> list[str]:
    return [name for entry in node["inputs"] for name in named_values(entry["arg"])]


def _moved(r: Reader, x: int, places: np.ndarray) -> Index:
    """The numbers of an item at flat positions from 1 on, in their shape; 0: the number 0."""
    if places.size == 0:
        raise InputError("leaves nothing", fix="check the sizes")
    shape, inside = _apart(places.shape)
    index = (places.astype(np.int64) - 1).reshape(shape)
    same = index.size == math.prod(r.builder.shape(x)) and bool((index.reshape(-1) == np.arange(index.size)).all())
    return Index(r.builder.reshape(x, shape) if same else r.builder.rearranged(x, index), inside)


def _parts(r: Reader, a: Arguments, name: str, kind: str) -> list[Index]:
    """Split and chunk; of channels they keep windows small."""
    value, rank = a.get("self"), 1 + len(r.builder.shape(a.get("self").number))
    if value.whole is not None or int(a.get("dim", 0)) % rank == 0:
        return _moves(r, a)
    x = a.image("self")
    shape = r.builder.shape(x)
    axis = _axis(int(a.get("dim", 0)), 1 + len(shape))
    size = shape[axis]
    given = a.get(name)
    each = -(-size // max(1, int(given))) if kind == "chunk" else given
    sizes = [int(v) for v in each] if isinstance(each, list) else [int(each)] * (size // max(1, int(each)))
    if sum(sizes) < size and not isinstance(each, list):
        sizes.append(size - sum(sizes))
    if sum(sizes) != size or min(sizes) < 1:
        raise InputError(f"argument {name} = {given} of {size}", fix="check the sizes")
    found, done = [], 0
    for length in sizes:
        chosen = [slice(None)] * len(shape)
        chosen[axis] = slice(done, done + length)
        found.append(Index(r.builder.part(x, chosen)))
        done += length
    return found


def _pool(r: Reader, a: Arguments) -> tuple[int, Any, Any, Any, Any, Any]:
    x = a.image("self")
    if len(r.builder.shape(x)) != 3:
        raise InputError(f"input {item(r.builder.shape(x))}", fix="only two-dimensional pooling is read")
    kernel = a.pair("kernel_size", _ONES)
    stride, dilation = a.pair("stride", kernel), a.pair("dilation", _ONES)
    pads = a.pair("padding", (0, 0)) * 2
    more = r.builder.rounded_up(x, kernel, stride, dilation, pads) if a.get("ceil_mode", False) else (0, 0)
    return x, kernel, stride, dilation, pads, more


def _average_pool(r: Reader, a: Arguments) -> Index:
    x, kernel, stride, _, pads, more = _pool(r, a)
    counted = bool(a.get("count_include_pad", True))
    return Index(r.builder.average_windows(x, kernel, stride, pads, more, counted))


def _max_pool(r: Reader, a: Arguments) -> Index:
    x, kernel, stride, dilation, pads, more = _pool(r, a)
    return Index(r.builder.max_pool(x, kernel, stride, dilation, (*pads[:2], pads[2] + more[0], pads[3] + more[1])))


def _adaptive(r: Reader, a: Arguments) -> Index:
    x, size = a.image("self"), a.pair("output_size", _ONES)
    shape = r.builder.shape(x)
    if len(shape) != 3 or min(size) < 1:
        raise InputError(f"argument output_size = {list(size)} of {item(shape)}", fix="a map and its size expected")
    if shape[1] % size[0] or shape[2] % size[1]:
        r.builder.reserve(4.0 * shape[0] * size[0] * size[1])
        return Index(r.builder.resize(x, [_average(n, m) for n, m in zip(shape[1:], size, strict=True)]))
    kernel = shape[1] // size[0], shape[2] // size[1]
    return Index(r.builder.average_pool(x, kernel, kernel, (0, 0, 0, 0), True))


def _axis(value: int, rank: int) -> int:
    """An axis of the item."""
    if not -rank <= value < rank or value % rank == 0:
        raise InputError(f"axis {value} is not supported", fix="the batch, axis 0, must stay")
    return value % rank - 1


def _flatten(r: Reader, a: Arguments) -> Any:
    if _mixed(a):
        return _moves(r, a)
    x = a.image("self")
    shape = r.builder.shape(x)
    rank = 1 + len(shape)
    first, last = _axis(int(a.get("start_dim", 0)), rank), _axis(int(a.get("end_dim", -1)), rank)
    joined = int(np.prod(shape[first : last + 1]))
    return Index(r.builder.reshape(x, (*shape[:first], joined, *shape[last + 1 :])))


def _view(r: Reader, a: Arguments) -> Any:
    if _mixed(a):
        return _moves(r, a)
    x = a.image("self")
    shape = r.builder.shape(x)
    target = [int(v) for v in (a.get("size") if "size" in a.found else a.get("shape"))]
    if target[0] not in (1, r.batch, -1) and r.batch == 1:
        return _moves(r, a)
    total = int(np.prod(shape))
    # the stored batch stands for any
    if target[0] not in (1, r.batch, -1) or target.count(-1) > 1:
        raise InputError(f"shape {target} of an item {item(shape)} moves the batch", fix="keep the batch first")
    rest = int(np.prod([v for v in target[1:] if v != -1], dtype=np.int64))
    found = [total // max(1, rest) if v == -1 else v for v in target[1:]]
    if int(np.prod(found)) != total:
        if r.batch == 1:
            return _moves(r, a)
        raise InputError(f"shape {target} of an item {item(shape)} moves the batch", fix="keep the batch first")
    return Index(r.builder.reshape(x, found))


def _slice(r: Reader, a: Arguments) -> Any:
    if _mixed(a):
        return _moves(r, a)
    x = a.image("self")
    rank = 1 + len(r.builder.shape(x))
    dim, start, end = int(a.get("dim", 0)), a.get("start"), a.get("end")
    step = int(a.get("step", 1))
    if dim % rank == 0:
        if start not in (None, 0) or (end is not None and end < 2**31):
            raise InputError("takes part of the batch", fix="keep the batch")
        return Index(x)
    chosen = [slice(None)] * (rank - 1)
    chosen[_axis(dim, rank)] = slice(start, end, step)
    return Index(r.builder.part(x, chosen))


def _cat(r: Reader, a: Arguments) -> Index:
    parts = a.get("tensors")
    rank = len(_whole(r, parts[0])[1])
    axis = int(a.get("dim", 0)) % rank
    if axis == 0:
        raise InputError("joins along the batch", fix="the batch, axis 0, must stay")
    return _joined(r, parts, axis)


def _pad(r: Reader, a: Arguments) -> Index:
    x = a.image("self")
    shape = r.builder.shape(x)
    pads = [int(v) for v in a.get("pad")]
    a.only("mode", "constant", "reflect", "replicate", "circular")
    mode, value = a.get("mode", "constant"), a.get("value")
    if len(pads) % 2 or len(pads) > 2 * len(shape):
        raise InputError(f"argument pad = {pads}", fix="two numbers an axis, none of the batch")
    before, after = [0] * len(shape), [0] * len(shape)
    for k in range(len(pads) // 2):
        before[-1 - k], after[-1 - k] = pads[2 * k], pads[2 * k + 1]
    mode = {"replicate": "edge", "circular": "wrap"}.get(str(mode), str(mode))
    return Index(r.builder.pad(x, before, after, mode, 0.0 if value is None else float(value)))


def _same(r: Reader, a: Arguments) -> Index:
    a.ignore("memory_format")
    return Index(*_image(a, "self"))


def _dropout(r: Reader, a: Arguments) -> Index:
    a.only("train", False)
    a.ignore("p")
    return Index(*_image(a, "input" if "input" in a.found else "self"))


def _batch_size(r: Reader, a: Arguments) -> int:
    x, dim = a.image("self"), int(a.get("dim"))
    return int((1, *r.builder.shape(x))[dim])


_VIEWS = frozenset(
    (
        "alias", "chunk", "contiguous", "detach", "diagonal", "dropout", "expand", "expand_as",
        "feature_dropout", "flatten", "movedim", "narrow", "permute", "reshape", "select", "slice", "split",
        "split_with_sizes", "squeeze", "swapaxes", "t", "to", "transpose", "unbind", "unflatten", "unsqueeze",
        "view",
    )
)  # fmt: skip
#: Operators that are only read where all is constant.
_FOLDED = frozenset(
    (
        "_weight_norm.default", "arange.default", "arange.start", "arange.start_step", "bitwise_and.Tensor",
        "bitwise_not.default", "detach_.default", "eq.Scalar", "eq.Tensor", "full.default", "full_like.default",
        "ge.Scalar", "ge.Tensor", "gt.Scalar", "gt.Tensor", "le.Scalar", "le.Tensor", "lift_fresh_copy.default",
        "linspace.default", "logical_and.default", "logical_not.default", "logical_or.default", "lt.Scalar",
        "lt.Tensor", "ne.Scalar", "new_full.default", "new_ones.default", "new_zeros.default", "ones.default",
        "ones_like.default", "outer.default", "scalar_tensor.default", "sin.default", "cos.default",
        "tril.default", "triu.default", "zeros.default", "zeros_like.default",
    )
)  # fmt: skip
#: Those that only move numbers.
_MOVES = frozenset(
    (
        "channel_shuffle.default", "diagonal.default", "flip.default", "im2col.default", "index.Tensor",
        "index_select.default", "movedim.int", "movedim.intlist", "narrow.default", "permute.default",
        "pixel_shuffle.default", "pixel_unshuffle.default", "repeat.default", "roll.default", "rot90.default",
        "select.int", "squeeze.default", "squeeze.dim", "squeeze.dims", "swapaxes.default", "t.default", "tile.default",
        "transpose.int", "unbind.int", "unflatten.int", "unsqueeze.default",
    )
)  # fmt: skip
_RULES: dict[str, Rule] = {
    **dict.fromkeys(_MOVES, _moves),
    "abs.default": _curve(curves.Abs),
    "adaptive_avg_pool1d.default": _on_map(_adaptive, "self"),
    "adaptive_avg_pool2d.default": _adaptive,
    "add.Tensor": _sum(1),
    "add_.Tensor": _sum(1),
    "addcmul.default": _addcmul,
    "addmm.default": _addmm,
    "alias.default": _same,
    "amax.default": _reduced("amax"),
    "amin.default": _reduced("amin"),
    "avg_pool1d.default": _on_map(_average_pool, "self"),
    "avg_pool2d.default": _average_pool,
    "batch_norm.default": _batch_norm,
    "bmm.default": _matmul,
    "cat.default": _cat,
    "celu.default": _unary(_celu),
    "chunk.default": lambda r, a: _parts(r, a, "chunks", "chunk"),
    "clamp.default": _unary(_clamp),
    "clamp_max.default": _unary(_clamp),
    "clamp_min.default": _unary(_clamp),
    "clone.default": _same,
    "constant_pad_nd.default": _pad,
    "contiguous.default": _same,
    "conv1d.default": _on_map(_conv, "input", "weight"),
    "conv2d.default": _conv,
    "conv_transpose1d.default": _on_map(_conv_transpose, "input", "weight"),
    "conv_transpose2d.input": _conv_transpose,
    "detach.default": _same,
    "div.Tensor": _div,
    "dropout.default": _dropout,
    "dropout_.default": _dropout,
    "einsum.default": _einsum,
    "elu.default": _unary(_elu),
    "erf.default": _curve(curves.Erf),
    "exp.default": _curve(curves.Exp),
    "expand.default": _expand,
    "expand_as.default": _expand_as,
    "feature_dropout.default": _dropout,
    "feature_dropout_.default": _dropout,
    "flatten.using_ints": _flatten,
    "gelu.default": _unary(_gelu),
    "glu.default": _glu,
    "group_norm.default": _group_norm,
    "hardsigmoid.default": _unary(_hard_sigmoid),
    "hardswish.default": _curve(curves.HardSwish),
    "hardswish_.default": _curve(curves.HardSwish),
    "hardtanh.default": _unary(_hardtanh),
    "hardtanh_.default": _unary(_hardtanh),
    "instance_norm.default": _group_norm,
    "layer_norm.default": _layer_norm,
    "leaky_relu.default": _unary(lambda b, x, a: b.prelu(x, np.asarray(_number(a, "negative_slope", 0.01)))),
    "leaky_relu_.default": _unary(lambda b, x, a: b.prelu(x, np.asarray(_number(a, "negative_slope", 0.01)))),
    "linalg_vector_norm.default": _vector_norm,
    "linear.default": _linear,
    "log.default": _unary(lambda b, x, a: b.logarithm(x)),
    "log_sigmoid.default": _unary(_log_sigmoid),
    "log_softmax.int": _softmax(True),
    "masked_fill.Scalar": _masked_fill,
    "matmul.default": _matmul,
    "max_pool1d.default": _on_map(_max_pool, "self"),
    "max_pool2d.default": _max_pool,
    "maximum.default": _extreme(True),
    "mean.dim": _reduced("mean"),
    "minimum.default": _extreme(False),
    "mish.default": _curve(curves.Mish),
    "mm.default": _matmul,
    "mul.Tensor": _mul,
    "neg.default": _unary(lambda b, x, a: b.scale(x, -np.ones(()), None)),
    "pad.default": _pad,
    "pow.Tensor_Scalar": _pow,
    "prelu.default": _prelu,
    "reciprocal.default": _unary(lambda b, x, a: b.reciprocal(x)),
    "relu.default": _unary(lambda b, x, a: b.leaky_relu(x, 0.0)),
    "relu6.default": _unary(lambda b, x, a: b.clip(x, 0.0, 6.0)),
    "relu_.default": _unary(lambda b, x, a: b.leaky_relu(x, 0.0)),
    "reshape.default": _view,
    "rsub.Scalar": _rsub,
    "scaled_dot_product_attention.default": _attention,
    "selu.default": _unary(_selu),
    "sigmoid.default": _unary(lambda b, x, a: b.sigmoid(x)),
    "silu.default": _curve(curves.Silu),
    "silu_.default": _curve(curves.Silu),
    "slice.Tensor": _slice,
    "softmax.int": _softmax(False),
    "softplus.default": _unary(_softplus),
    "softshrink.default": _unary(_softshrink),
    "split.Tensor": lambda r, a: _parts(r, a, "split_size", "split"),
    "split_with_sizes.default": lambda r, a: _parts(r, a, "split_sizes", "split"),
    "sqrt.default": _unary(lambda b, x, a: b.power(x, 0.5)),
    "square.default": _unary(lambda b, x, a: b.power(x, 2.0)),
    "stack.default": _stack,
    "std.correction": _variance(True),
    "std.dim": _variance(True),
    "sub.Tensor": _sum(-1),
    "sum.dim_IntList": _reduced("sum"),
    "sym_size.int": _batch_size,
    "tanh.default": _unary(lambda b, x, a: b.tanh(x)),
    "threshold.default": _unary(_threshold),
    "to.dtype": _to,
    "upsample_bicubic2d.vec": _upsample("cubic"),
    "upsample_bilinear2d.vec": _upsample("linear"),
    "upsample_nearest2d.vec": _upsample("nearest"),
    "var.correction": _variance(False),
    "var.dim": _variance(False),
    "view.default": _view,
    "where.ScalarOther": _where,
    "where.ScalarSelf": _where,
    "where.self": _where,
}
#: Those that read values with the batch inside their shape, too: all functions of every number among them.
_ANYWHERE = _MOVES | frozenset(
    (
        "add.Tensor", "add_.Tensor", "alias.default", "bmm.default", "cat.default", "chunk.default", "clone.default",
        "contiguous.default", "detach.default", "dropout.default", "dropout_.default", "einsum.default",
        "flatten.using_ints", "gelu.default", "layer_norm.default", "linear.default", "matmul.default", "mm.default",
        "relu.default", "relu_.default", "reshape.default", "sigmoid.default", "silu.default", "slice.Tensor",
        "split.Tensor", "split_with_sizes.default", "stack.default", "sub.Tensor", "tanh.default", "to.dtype",
        "view.default",
    )
)  # fmt: skip
#: What is read of torch's graphs.
OPERATORS = Operators(_RULES, _FOLDED, _ANYWHERE, _VIEWS)
