"""numba intrinsics for compiled kernels: pointers, prefetching, atomic counters, bits."""

from __future__ import annotations

from llvmlite import ir
from numba import config, types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np import arrayobj


@intrinsic
def borrowed(typingctx, array):  # pyright: ignore[reportRedeclaration]
    """Return the same array without a reference to its owner.

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


@intrinsic
def prefetch(typingctx, array, row, byte):  # pyright: ignore[reportRedeclaration]
    """Prefetch the cache line at byte ``byte`` of ``array[row]`` (or of a `pointer`'s element); changes no value."""
    if not isinstance(array, types.Array | types.CPointer):
        raise TypeError(f"prefetch() takes an array or a pointer, not {array}")

    def codegen(context, builder, signature, args):
        if isinstance(array, types.Array):
            source = arrayobj.make_array(signature.args[0])(context, builder, args[0])
            start, stride = source.data, cgutils.unpack_tuple(builder, source.strides)[0]
        else:
            start, stride = args[0], args[1].type(context.get_abi_sizeof(context.get_data_type(array.dtype)))
        offset = builder.add(builder.mul(stride, args[1]), args[2])
        raw = ir.IntType(8).as_pointer()
        address = builder.gep(builder.bitcast(start, raw), [offset], source_etype=ir.IntType(8))
        int32 = ir.IntType(32)
        function = builder.module.declare_intrinsic(
            "llvm.prefetch", [raw], ir.FunctionType(ir.VoidType(), [raw, int32, int32, int32])
        )
        # read, keep in all levels, data
        builder.call(function, [address, int32(0), int32(3), int32(1)])
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp), codegen


@intrinsic
def pointer(typingctx, array):  # pyright: ignore[reportRedeclaration]
    """Return elements of a contiguous array, in memory order, to be indexed from 0; the caller keeps the owner alive.

    Unlike an array it is not counted, has no size and knows no negative index, which short loops notice.
    """
    if not isinstance(array, types.Array) or array.layout != "C":
        raise TypeError(f"pointer() takes a contiguous array, not {array}")

    def codegen(context, builder, signature, args):
        return arrayobj.make_array(signature.args[0])(context, builder, args[0]).data

    return types.CPointer(array.dtype)(array), codegen


@intrinsic
def offset_by(typingctx, elements, count):  # pyright: ignore[reportRedeclaration]
    """Return a `pointer` to the element ``count`` further on."""

    def codegen(context, builder, signature, args):
        kind = context.get_data_type(signature.return_type.dtype)
        return builder.gep(args[0], [args[1]], source_etype=kind)

    return elements(elements, types.intp), codegen


@intrinsic
def taken(typingctx, counter):  # pyright: ignore[reportRedeclaration]
    """Add 1 atomically to the int64 at the `pointer`; return its value before, which no other thread gets."""
    if counter != types.CPointer(types.int64):
        raise TypeError(f"taken() takes the pointer to an int64 array, not {counter}")

    def codegen(context, builder, signature, args):
        return builder.atomic_rmw("add", args[0], ir.IntType(64)(1), "monotonic")

    return types.int64(counter), codegen


@intrinsic
def lowest_bit(typingctx, mask):  # pyright: ignore[reportRedeclaration]
    """Return the number of the lowest bit that is set in an int64 that is not 0."""

    def codegen(context, builder, signature, args):
        return builder.cttz(args[0], ir.IntType(1)(1))

    return types.int64(types.int64), codegen


@intrinsic
def signed(typingctx, bits):  # pyright: ignore[reportRedeclaration]
    """Reinterpret 64 bits as an int64."""
    return types.int64(types.int64), lambda context, builder, signature, args: args[0]


if config.DISABLE_JIT:  # pyright: ignore[reportAttributeAccessIssue]

    def borrowed(array):
        """The array itself: the interpreter counts its references."""
        return array

    def prefetch(array, row, byte):
        """Nothing: the interpreter has no say in caches."""

    def pointer(array):
        """The elements of an array."""
        return array.reshape(-1)

    def offset_by(elements, count):
        """The elements without the first ``count``."""
        return elements[count:]

    def taken(counter):
        """What the first element was before it grew by 1."""
        counter[0] += 1
        return int(counter[0]) - 1

    def lowest_bit(mask):
        """Number of the lowest bit that is set."""
        mask = int(mask)
        return (mask & -mask).bit_length() - 1

    def signed(bits):
        """The lowest 64 bits as an int64."""
        return (int(bits) + 2**63) % 2**64 - 2**63
