"""Several floats side by side: explicit vectors for compiled kernels.

`load8` and `load4` take 8 or 4 neighbouring doubles as one value, `load_line` 8 doubles or 16 float32. ``+ - * /``,
comparisons, ``abs``, and the functions below work lane by lane on such values and on floats of their type, which stand
for all lanes; every lane is rounded as that type's arithmetic is. Interpreted, lanes are arrays.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable

import numpy as np
from llvmlite import ir
from numba import config, types
from numba.core import cgutils
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

_FLOATS = {types.float64: ir.DoubleType(), types.float32: ir.FloatType()}
_SUFFIXES = {ir.DoubleType(): "f64", ir.FloatType(): "f32"}
_INT32 = ir.IntType(32)

#: Bytes of a cache line, and of the longest lanes.
LINE = 64


class LanesType(types.Type):
    """numba's type of a vector of ``width`` floats of the type ``element``."""

    def __init__(self, width: int, element: types.Float = types.float64) -> None:
        self.width, self.element = width, element
        super().__init__(name=f"Lanes({width} {element})")


class MaskType(types.Type):
    """numba's type of a vector of ``width`` truth values."""

    def __init__(self, width: int) -> None:
        self.width = width
        super().__init__(name=f"Mask({width})")


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, ir.VectorType(_FLOATS[kind.element], kind.width))


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, ir.VectorType(ir.IntType(1), kind.width))


#: Lanes and masks by width, which tells the type of the elements.
_KINDS = {
    width: (LanesType(width, element), MaskType(width))
    for width, element in ((4, types.float64), (8, types.float64), (16, types.float32))
}


def _width(*kinds: types.Type) -> int:
    """Return the number of lanes of an operation on arguments of the types ``kinds``; 0: all are scalars."""
    widths = {kind.width for kind in kinds if isinstance(kind, LanesType | MaskType)}
    if len(widths) > 1:
        raise TypeError(f"lanes of different widths: {kinds}")
    return widths.pop() if widths else 0


def _wide(builder, value, kind: types.Type, width: int):
    """Return ``value`` itself, or copied to all ``width`` lanes if it is a scalar."""
    if width == 0 or isinstance(kind, LanesType | MaskType):
        return value
    vector = ir.VectorType(value.type, width)
    nothing, first = ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(_INT32, width), None)
    return builder.shuffle_vector(builder.insert_element(nothing, value, _INT32(0)), nothing, first)


def operands(builder, sig, args):
    """Return the arguments of a call with scalars copied to all lanes, so that all have one type."""
    width = _width(*sig.args)
    return [_wide(builder, value, kind, width) for value, kind in zip(args, sig.args, strict=True)]


def _typed(function: Callable, cases: list) -> None:
    """Register the signatures ``cases`` of ``function`` with numba's type inference."""
    template = type(f"_Of{function.__name__}", (ConcreteTemplate,), {"cases": cases})
    infer_global(function)(template)  # pyright: ignore[reportOptionalCall]


def _register(function: Callable, arguments: int, masks: bool, build: Callable) -> None:
    """Make numba compile ``function`` for lanes (and floats); ``build(builder, *values)`` emits its LLVM code."""
    cases = []
    for lanes, mask in _KINDS.values():
        result = mask if masks else lanes
        cases.append(signature(result, *[lanes] * arguments))
        if arguments == 2:
            cases += [signature(result, lanes, lanes.element), signature(result, lanes.element, lanes)]

    _typed(function, cases)

    def lower(context, builder, sig, args):
        return build(builder, *operands(builder, sig, args))

    for case in cases:
        lower_builtin(function, *case.args)(lower)


_register(operator.add, 2, False, lambda builder, a, b: builder.fadd(a, b))
_register(operator.sub, 2, False, lambda builder, a, b: builder.fsub(a, b))
_register(operator.mul, 2, False, lambda builder, a, b: builder.fmul(a, b))
_register(operator.truediv, 2, False, lambda builder, a, b: builder.fdiv(a, b))
_register(operator.neg, 1, False, lambda builder, a: builder.fneg(a))
for _function, _sign in (
    (operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">="), (operator.eq, "=="),
):  # fmt: skip
    _register(_function, 2, True, lambda builder, a, b, sign=_sign: builder.fcmp_ordered(sign, a, b))
_register(operator.ne, 2, True, lambda builder, a, b: builder.fcmp_unordered("!=", a, b))


def by_intrinsic(name: str, builder, *values):
    """Call LLVM's intrinsic ``name`` on floats or lanes, all of one type."""
    kind = values[0].type
    suffix = f"v{kind.count}{_SUFFIXES[kind.element]}" if isinstance(kind, ir.VectorType) else _SUFFIXES[kind]
    function = ir.FunctionType(kind, [kind] * len(values))
    return builder.call(cgutils.get_or_insert_function(builder.module, function, f"llvm.{name}.{suffix}"), values)


_register(abs, 1, False, lambda builder, a: by_intrinsic("fabs", builder, a))
for _lanes, _mask in _KINDS.values():
    for _function in (operator.and_, operator.or_):
        _typed(_function, [signature(_mask, _mask, _mask)])


@lower_builtin(operator.and_, MaskType, MaskType)
def _both(context, builder, sig, args):
    return builder.and_(*args)


@lower_builtin(operator.or_, MaskType, MaskType)
def _either(context, builder, sig, args):
    return builder.or_(*args)


def common_type(*kinds: types.Type) -> types.Type:
    """Return lanes where one of ``kinds`` is, else float64."""
    width = _width(*kinds)
    return _KINDS[width][0] if width else types.float64


@intrinsic
def muladd(typingctx, x, y, z):  # pyright: ignore[reportRedeclaration]
    """Return ``x * y + z``, rounded once or twice, whichever the processor does faster."""

    def codegen(context, builder, sig, args):
        return by_intrinsic("fmuladd", builder, *operands(builder, sig, args))

    return common_type(x, y, z)(x, y, z), codegen


def _choice(sign: str):
    """Return ``b if b sign a else a``, as the built-in ``max`` and ``min`` decide, also for NaN."""

    def codegen(context, builder, sig, args):
        a, b = operands(builder, sig, args)
        return builder.select(builder.fcmp_ordered(sign, b, a), b, a)

    return codegen


@intrinsic
def maximum(typingctx, a, b):  # pyright: ignore[reportRedeclaration]
    """Return ``max(a, b)``."""
    return common_type(a, b)(a, b), _choice(">")


@intrinsic
def minimum(typingctx, a, b):  # pyright: ignore[reportRedeclaration]
    """Return ``min(a, b)``."""
    return common_type(a, b)(a, b), _choice("<")


@intrinsic
def root(typingctx, a):  # pyright: ignore[reportRedeclaration]
    """Return the square root, rounded to nearest."""
    return a(a), lambda context, builder, sig, args: by_intrinsic("sqrt", builder, args[0])


@intrinsic
def where(typingctx, mask, a, b):  # pyright: ignore[reportRedeclaration]
    """Return ``a`` where ``mask`` holds, else ``b``."""

    def codegen(context, builder, sig, args):
        condition, a, b = args
        width = _width(*sig.args)
        a, b = _wide(builder, a, sig.args[1], width), _wide(builder, b, sig.args[2], width)
        return builder.select(condition, a, b)

    return common_type(mask, a, b)(mask, a, b), codegen


@intrinsic
def bits(typingctx, mask):  # pyright: ignore[reportRedeclaration]
    """Return an int64 whose bit k is 1 where lane k of ``mask`` holds."""

    def codegen(context, builder, sig, args):
        packed = builder.bitcast(args[0], ir.IntType(sig.args[0].width))
        return builder.zext(packed, ir.IntType(64))

    return types.int64(mask), codegen


@intrinsic
def lane_sum(typingctx, a):  # pyright: ignore[reportRedeclaration]
    """Return the sum of the lanes, added half to half: rounded as often as the lanes can be halved."""

    def codegen(context, builder, sig, args):
        value, width = args[0], sig.args[0].width
        while width > 1:
            width //= 2
            low, high = (
                ir.Constant(ir.VectorType(_INT32, width), [_INT32(k + at) for k in range(width)]) for at in (0, width)
            )
            value = builder.fadd(builder.shuffle_vector(value, value, low), builder.shuffle_vector(value, value, high))
        return builder.extract_element(value, _INT32(0))

    return a.element(a), codegen


@intrinsic
def spans(typingctx, first, last):  # pyright: ignore[reportRedeclaration]
    """Return an int64: in byte k the bits from ``ceil(first)`` to ``floor(last)`` of lane k; 8 lanes of -1 to 8."""

    def codegen(context, builder, sig, args):
        wide = ir.VectorType(ir.IntType(64), 8)
        one, none = ir.Constant(wide, [1] * 8), ir.Constant(wide, [0] * 8)
        start = builder.fptosi(by_intrinsic("ceil", builder, args[0]), wide)
        past = builder.add(builder.fptosi(by_intrinsic("floor", builder, args[1]), wide), one)
        run = builder.sub(builder.shl(one, past), builder.shl(one, start))
        run = builder.select(builder.icmp_signed(">", past, start), run, none)
        return builder.bitcast(builder.trunc(run, ir.VectorType(ir.IntType(8), 8)), ir.IntType(64))

    return types.int64(_KINDS[8][0], _KINDS[8][0]), codegen


def _address(builder, elements, at, kind: LanesType):
    element = _FLOATS[kind.element]
    address = builder.gep(elements, [at], source_etype=element)
    return builder.bitcast(address, ir.VectorType(element, kind.width).as_pointer())


def _check(elements, kind: LanesType) -> None:
    if elements != types.CPointer(kind.element):
        raise TypeError(f"{kind} are read and written through pointer({kind.element} array), not {elements}")


def _loader(elements, width: int):
    kind = _KINDS[width][0]
    _check(elements, kind)

    def codegen(context, builder, sig, args):
        address = _address(builder, args[0], args[1], kind)
        vector = ir.VectorType(_FLOATS[kind.element], width)
        return builder.load(address, align=kind.element.bitwidth // 8, typ=vector)

    return kind(elements, types.intp), codegen


@intrinsic
def load8(typingctx, elements, at):  # pyright: ignore[reportRedeclaration]
    """Return ``elements[at : at + 8]`` of an `intrinsics.pointer` as lanes."""
    return _loader(elements, 8)


@intrinsic
def load4(typingctx, elements, at):  # pyright: ignore[reportRedeclaration]
    """Return ``elements[at : at + 4]`` of an `intrinsics.pointer` as lanes."""
    return _loader(elements, 4)


@intrinsic
def load_line(typingctx, elements, at):  # pyright: ignore[reportRedeclaration]
    """Load `LINE` bytes, float64 or float32 numbers from ``elements[at]`` of an `intrinsics.pointer` on, as lanes."""
    if not isinstance(elements, types.CPointer) or elements.dtype not in _FLOATS:
        raise TypeError(f"lanes are read through pointer(float64 or float32 array), not {elements}")
    return _loader(elements, 8 * LINE // elements.dtype.bitwidth)


@intrinsic
def store(typingctx, elements, at, lanes):  # pyright: ignore[reportRedeclaration]
    """Write the lanes to ``elements[at : ...]`` of an `intrinsics.pointer`."""
    _check(elements, lanes)

    def codegen(context, builder, sig, args):
        kind = sig.args[2]
        builder.store(args[2], _address(builder, args[0], args[1], kind), align=kind.element.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(elements, types.intp, lanes), codegen


def _transposed(builder, rows):
    """Return the columns of 8 rows of 8 lanes."""

    def mixed(a, b, picks):
        return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_INT32, 8), [_INT32(p) for p in picks]))

    # pairs of rows, then of pairs, then of fours
    for step in (1, 2, 4):
        done = list(rows)
        for low in range(8):
            if low & step:
                continue
            a, b = rows[low], rows[low + step]
            done[low] = mixed(a, b, [p if not p & step else 8 + (p ^ step) for p in range(8)])
            done[low + step] = mixed(a, b, [p | step if not p & step else 8 + p for p in range(8)])
        rows = done
    return rows


@intrinsic
def store_columns(typingctx, elements, at, stride, rows):  # pyright: ignore[reportRedeclaration]
    """Write lane k of the eight ``rows`` side by side to ``elements[at + stride k : ...]`` of a pointer."""
    _check(elements, _KINDS[8][0])

    def codegen(context, builder, sig, args):
        for k, row in enumerate(_transposed(builder, cgutils.unpack_tuple(builder, args[3]))):
            at = builder.add(args[1], builder.mul(args[2], args[2].type(k)))
            builder.store(row, _address(builder, args[0], at, _KINDS[8][0]), align=8)
        return context.get_dummy_value()

    return types.void(elements, types.intp, types.intp, rows), codegen


@intrinsic
def scatter_columns(typingctx, elements, places, first, stride, shift, rows):  # pyright: ignore[reportRedeclaration]
    """Write lane k of the eight ``rows`` side by side to ``elements[stride * places[first + k] + shift : ...]``."""
    _check(elements, _KINDS[8][0])
    if places != types.CPointer(types.int64):
        raise TypeError(f"places are read through pointer(int64 array), not {places}")

    def codegen(context, builder, sig, args):
        int64 = ir.IntType(64)
        for k, row in enumerate(_transposed(builder, cgutils.unpack_tuple(builder, args[5]))):
            address = builder.gep(args[1], [builder.add(args[2], int64(k))], source_etype=int64)
            at = builder.add(builder.mul(builder.load(address, typ=int64), args[3]), args[4])
            builder.store(row, _address(builder, args[0], at, _KINDS[8][0]), align=8)
        return context.get_dummy_value()

    return types.void(elements, places, types.intp, types.intp, types.intp, rows), codegen


if config.DISABLE_JIT:  # pyright: ignore[reportAttributeAccessIssue]

    def maximum(a, b):
        """``max(a, b)``."""
        return where(b > a, b, a)

    def minimum(a, b):
        """``min(a, b)``."""
        return where(b < a, b, a)

    def root(a):
        """Square root, rounded to nearest."""
        return np.sqrt(a)

    def where(mask, a, b):
        """``a`` where ``mask`` holds, else ``b``."""
        return np.where(mask, a, b) if np.ndim(mask) else (a if mask else b)

    def bits(mask):
        """Bit k of the result tells whether lane k of ``mask`` holds."""
        return sum(1 << k for k, holds in enumerate(mask) if holds)

    def lane_sum(a):
        """Sum of the lanes, in halves: rounded as often as there are halvings."""
        while len(a) > 1:
            a = a[: len(a) // 2] + a[len(a) // 2 :]
        return a[0]

    def spans(first, last):
        """Byte k of the result has the bits from ``ceil(first)`` to ``floor(last)`` of lane k."""
        runs = [max(0, (1 << math.floor(b) + 1) - (1 << math.ceil(a))) for a, b in zip(first, last, strict=True)]
        return sum(run << 8 * k for k, run in enumerate(runs))

    def muladd(x, y, z):
        """``x * y + z``, rounded twice."""
        return x * y + z

    def load8(elements, at):
        """``elements[at : at + 8]``."""
        return elements[at : at + 8].copy()

    def load4(elements, at):
        """``elements[at : at + 4]``."""
        return elements[at : at + 4].copy()

    def load_line(elements, at):
        """`LINE` bytes from ``elements[at]`` on."""
        return elements[at : at + LINE // elements.itemsize].copy()

    def store(elements, at, lanes):
        """Write the lanes to ``elements[at : ...]``."""
        elements[at : at + len(lanes)] = lanes

    def store_columns(elements, at, stride, rows):
        """Write lane k of the eight values side by side to ``elements[at + stride k : ...]``."""
        for k, row in enumerate(np.stack(rows, axis=1)):
            elements[at + stride * k : at + stride * k + 8] = row

    def scatter_columns(elements, places, first, stride, shift, rows):
        """Write lane k of the eight ``rows`` side by side to ``elements[stride * places[first + k] + shift : ...]``."""
        for k, row in enumerate(np.stack(rows, axis=1)):
            at = stride * int(places[first + k]) + shift
            elements[at : at + 8] = row
