"""Contractions of nodes and constants (einsum, matrix products) and concatenation, in the file's shapes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ns_abstract.io.errors import InputError
from ns_abstract.verify.network.composite_layers import CompositeBuilder
from ns_abstract.verify.network.graph import item
from ns_abstract.verify.network.layers import Shape

#: A node or a constant, with its shape as the file sees it: with the batch, where there is one.
Operand = tuple[int | np.ndarray, Shape]


def einsum(b: CompositeBuilder, equation: str, operands: Sequence[Operand]) -> tuple[int, Shape]:
    """Add an einsum equation of one or two operands; return its node and shape. InputError if it is unsupported."""
    equation = equation.replace(" ", "")
    left, arrow, out = equation.partition("->")
    names = left.split(",")
    if not arrow:
        out = "".join(sorted(v for v in set(left) - {","} if left.count(v) == 1))
    letters = [*names, out]
    if len(names) != len(operands) or not 1 <= len(names) <= 2 or not all(v.isalpha() or not v for v in letters):
        raise InputError(f"equation = {equation} is not supported", fix="name all axes of one or two values")
    if any(len(set(v)) != len(v) for v in letters) or not set(out) <= set(left):
        raise InputError(f"equation = {equation} is not supported", fix="name every axis of a value once")
    sizes: dict[str, int] = {}
    for name, (_, shape) in zip(names, operands, strict=True):
        if len(name) != len(shape) or any(sizes.setdefault(v, n) != n for v, n in zip(name, shape, strict=True)):
            raise InputError(f"equation = {equation} on {item(shape)}", fix="check the sizes")
    first = names[0]
    second = names[1] if len(names) == 2 else ""
    both = [v for v in first if v in second]
    lead, inner = [v for v in both if v in out], [v for v in both if v not in out]
    rows, columns = ([v for v in name if v not in both and v in out] for name in (first, second))
    one = _axes_of(b, operands[0], first, lead, rows, inner, sizes)
    if len(operands) == 1:
        index, order = one, rows
    else:
        two = _axes_of(b, operands[1], second, lead, columns, inner, sizes)
        index, order = _matrices(b, one, two), [*lead, *rows, *columns]
    assert isinstance(index, int)
    index = b.transpose(b.reshape(index, tuple(sizes[v] for v in order) or (1,)), [order.index(v) for v in out] or [0])
    return index, tuple(sizes[v] for v in out)


def _axes_of(
    b: CompositeBuilder,
    operand: Operand,
    name: str,
    lead: list[str],
    own: list[str],
    inner: list[str],
    sizes: dict[str, int],
) -> int | np.ndarray:
    """Return an operand as matrices [lead, own, inner]; axes that only this operand has are summed."""
    value, whole = operand
    alone = [k for k, v in enumerate(name) if v not in (*lead, *own, *inner)]
    rest = [v for v in name if v in (*lead, *own, *inner)]
    order = [rest.index(v) for v in (*lead, *own, *inner)]
    shape = tuple(math.prod(sizes[v] for v in part) for part in (lead, own, inner))
    if not isinstance(value, int):
        if alone:
            # another order of the sum gives another constant
            raise InputError("sums up a constant", fix="fold constants when exporting, in float64")
        return np.asarray(value, np.float64).transpose(order).reshape(shape)
    index = b.reduce(b.reshape(value, whole), alone, False, False)
    return b.reshape(b.transpose(index, order) if rest else index, shape)


def _matrices(b: CompositeBuilder, one: int | np.ndarray, two: int | np.ndarray) -> int:
    """Add ``one two^T`` of matrices [N, R, K] and [N, C, K], as [N, R, C]."""
    if isinstance(one, int) and isinstance(two, int):
        return b.matmul(one, b.transpose(two, (0, 2, 1)))
    if not isinstance(one, int):
        assert isinstance(two, int)
        return b.transpose(_matrices(b, two, one), (0, 2, 1))
    assert not isinstance(two, int)
    n, rows, k = b.shape(one)
    if n == 1:
        return b.matrix(one, two[0], None)
    spread = b.spread(b.reshape(one, (n, rows, 1, k)), (n, rows, two.shape[1], k))
    return b.reduce(b.scale(spread, two[:, None], None), [3], False, False)


def matmul(b: CompositeBuilder, one: Operand, two: Operand) -> tuple[int, Shape]:
    """Add a product of matrices, at least one of which depends on the image; return its node and shape.

    Raises:
        InputError: The shapes do not fit, or a constant is more than one matrix.
    """
    (left, first), (right, second) = one, two
    if isinstance(left, int) and isinstance(right, int):
        rank = max(len(first), len(second))
        if min(len(first), len(second)) < 2:
            raise InputError(f"shapes {item(first)} and {item(second)}", fix="give both two axes or more")
        wholes = [(1,) * (rank - len(whole)) + whole for whole in (first, second)]
        lead = np.broadcast_shapes(wholes[0][:-2], wholes[1][:-2])
        # as items without a batch
        nodes = zip((left, right), wholes, strict=True)
        spread = (b.spread(b.reshape(index, whole), (*lead, *whole[-2:])) for index, whole in nodes)
        return b.matmul(*spread), (*lead, wholes[0][-2], wholes[1][-1])
    if isinstance(left, int):
        weight = _matrix(right)
        return b.matrix(left, weight.T, None), (*first[:-1], weight.shape[1])
    assert isinstance(right, int)
    weight = _matrix(left)
    if len(second) < 2:
        raise InputError(f"a value {item(second)}", fix="give it two axes or more")
    return b.matrix_from_left(weight, b.reshape(right, second)), (*second[:-2], weight.shape[0], second[-1])


def _matrix(constant: Any) -> Any:
    """Return a constant as a float64 matrix."""
    matrix = np.asarray(constant, np.float64)
    if matrix.ndim < 2 or math.prod(matrix.shape[:-2]) != 1:
        raise InputError(f"weights {item(matrix.shape)}", fix="a matrix expected")
    return matrix.reshape(matrix.shape[-2:])


def concatenated(b: CompositeBuilder, parts: Sequence[Operand], axis: int) -> tuple[int, Shape]:
    """Add a concatenation of nodes and constants along an axis; return its node and shape.

    Raises:
        InputError: They do not fit, or a constant is not finite.
    """
    shapes = [whole for _, whole in parts]
    if any(v[:axis] + v[axis + 1 :] != shapes[0][:axis] + shapes[0][axis + 1 :] for v in shapes):
        problem = f"shapes {[item(v) for v in shapes]} do not fit"
        raise InputError(problem, fix="check the axis, or export with a batch of 1")
    whole = (*shapes[0][:axis], sum(v[axis] for v in shapes), *shapes[0][axis + 1 :])
    after = whole[1:] if len(whole) > 1 and whole[0] == 1 else whole
    b.reserve(float(math.prod(whole)) * len(parts))
    moving, offset, done = [], np.zeros(whole), 0
    for value, shape in parts:
        place = (slice(None),) * axis + (slice(done, done + shape[axis]),)
        done += shape[axis]
        if isinstance(value, int):
            index = np.full(whole, -1, np.int64)
            index[place] = b.positions(value).reshape(shape)
            moving.append(b.gather(value, index.reshape(after)))
        else:
            offset[place] = value
    if not np.isfinite(offset).all():
        raise InputError("joins numbers that are not finite", fix="write the network without that")
    total = b.sum(tuple(moving), (1,) * len(moving), exact=True) if len(moving) > 1 else moving[0]
    return b.shift(total, offset.reshape(after)), whole
