"""Tools for compiled kernels."""

from __future__ import annotations

from numba import config, types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np import arrayobj


@intrinsic
def borrowed(typingctx, array):
    """The same array without a reference to its owner.

    Views and calls cost two atomic operations per counted array, which is more than the arithmetic
    of a short loop. The caller keeps the owner alive for as long as the result is used.
    """
    if not isinstance(array, types.Array):
        raise TypeError(f"borrowed() takes an array, not {array}")

    def codegen(context, builder, signature, args):
        source = arrayobj.make_array(signature.args[0])(context, builder, args[0])
        result = arrayobj.make_array(signature.return_type)(context, builder)
        arrayobj.populate_array(
            result,
            data=source.data,
            shape=cgutils.unpack_tuple(builder, source.shape),
            strides=cgutils.unpack_tuple(builder, source.strides),
            itemsize=source.itemsize,
            meminfo=None,
        )
        return result._getvalue()

    return array(array), codegen


if config.DISABLE_JIT:

    def borrowed(array):
        """The array itself: the interpreter counts its references."""
        return array
