"""Elementary functions for compiled kernels, with proven relative errors on every platform."""

from __future__ import annotations

import math
import struct
from fractions import Fraction

import numpy as np
from llvmlite import ir
from numba import config, njit
from numba.extending import intrinsic

from ns_abstract.arithmetic.simd.lanes import LanesType, by_intrinsic, common_type, operands

#: Where `exp_kernel` errs by no more than `rounding.EXP_RELATIVE_ERROR` of the value (design.md, E1).
EXP_LOWEST = -700.0
EXP_HIGHEST = 700.0

_LOG2E = 1.4426950408889634
# ln 2 split so that k * _LN2_HIGH is exact for |k| < 2**20 (fdlibm e_exp.c)
_LN2_HIGH = 6.93147180369123816490e-01
_LN2_LOW = 1.90821492927058770002e-10
_ROUND_TO_INTEGER = 6755399441055744.0  # 1.5 * 2**52
_INVERSE_FACTORIALS = tuple(1.0 / math.factorial(n) for n in range(13))
_C2, _C3, _C4, _C5, _C6, _C7 = _INVERSE_FACTORIALS[2:8]
_C8, _C9, _C10, _C11, _C12 = _INVERSE_FACTORIALS[8:13]


@intrinsic
def fma(typingctx, x, y, z):  # pyright: ignore[reportRedeclaration]
    """Return ``x * y + z`` with one rounding, of floats or lanes."""

    def codegen(context, builder, sig, args):
        return by_intrinsic("fma", builder, *operands(builder, sig, args))

    return common_type(x, y, z)(x, y, z), codegen


@intrinsic
def _power_of_low_bits(typingctx, shifted):  # pyright: ignore[reportRedeclaration]
    """Return 2 to the power of the low bits of ``shifted``, moved into the exponent field (bias 1023)."""

    def codegen(context, builder, sig, args):
        kind, bits = args[0].type, ir.IntType(64)
        if isinstance(sig.return_type, LanesType):
            bits = ir.VectorType(bits, kind.count)
            bias, place = (ir.Constant(bits, [n] * kind.count) for n in (1023, 52))
        else:
            bias, place = bits(1023), bits(52)
        moved = builder.shl(builder.add(builder.bitcast(args[0], bits), bias), place)
        return builder.bitcast(moved, kind)

    return shifted(shifted), codegen


if config.DISABLE_JIT:  # pyright: ignore[reportAttributeAccessIssue]

    def fma(x, y, z):
        """``x * y + z`` with one rounding, of floats or arrays."""
        if np.ndim(x) or np.ndim(y) or np.ndim(z):
            return np.array([fma(*one) for one in zip(*np.broadcast_arrays(x, y, z), strict=True)])
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
            return float(x) * float(y) + float(z)
        return float(Fraction(float(x)) * Fraction(float(y)) + Fraction(float(z)))

    def _power_of_low_bits(shifted):
        if np.ndim(shifted):
            return np.array([_power_of_low_bits(one) for one in shifted])
        bits = struct.unpack("<q", struct.pack("<d", shifted))[0]
        # the shift of an int64 drops what leaves its 64 bits
        return struct.unpack("<d", struct.pack("<Q", ((bits + 1023) << 52) & 0xFFFFFFFFFFFFFFFF))[0]


@njit(inline="always", error_model="numpy")
def exp_kernel(x):
    """Return exp(x), EXP_LOWEST <= x <= EXP_HIGHEST, of floats or lanes, within EXP_RELATIVE_ERROR of it (E1)."""
    shifted = fma(x, _LOG2E, _ROUND_TO_INTEGER)
    k = shifted - _ROUND_TO_INTEGER
    r = fma(-k, _LN2_HIGH, x)
    r = fma(-k, _LN2_LOW, r)
    # Estrin's scheme: short chains of dependent operations
    r2 = r * r
    r4 = r2 * r2
    a = fma(r2, fma(r, _C3, _C2), r)
    b = fma(r2, fma(r, _C7, _C6), fma(r, _C5, _C4))
    c = fma(r2, fma(r, _C11, _C10), fma(r, _C9, _C8))
    c = fma(r4, _C12, c)
    p = 1.0 + fma(r4, fma(r4, c, b), a)
    # the low bits of `shifted` hold k
    return p * _power_of_low_bits(shifted)
