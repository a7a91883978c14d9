"""Integer atomics and raw pointers for numba kernels: sums that come out the same at any thread count."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.extending import intrinsic
from numba.np.arrayobj import make_array


@intrinsic
def atomic_add(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """array[index] += value, atomically; index a tuple of integers or an integer; array of any integer dtype. Returns
    nothing.

    Monotonic order is enough: kernels only add, and are joined before anyone reads.
    """
    if not isinstance(array, types.Array) or not isinstance(array.dtype, types.Integer):
        return None
    indices: list[Any] = list(index.types) if isinstance(index, types.BaseTuple) else [index]  # type: ignore[attr-defined]

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array_type, index_type, value_type = signature.args
        ary = make_array(array_type)(context, builder, args[0])
        parts = cgutils.unpack_tuple(builder, args[1]) if isinstance(index_type, types.BaseTuple) else [args[1]]
        parts = [context.cast(builder, p, t, types.intp) for p, t in zip(parts, indices, strict=True)]
        pointer = cgutils.get_item_pointer(context, builder, array_type, ary, parts)
        builder.atomic_rmw("add", pointer, context.cast(builder, args[2], value_type, array_type.dtype), "monotonic")
        return context.get_dummy_value()

    return types.none(array, index, value), codegen


@intrinsic
def atomic_add_int64(typingctx: Any, address: Any, value: Any) -> Any:
    """*(int64 *)address += value, atomically; address uint64. Returns what was there before, int64."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address_type, value_type = signature.args
        pointer = builder.inttoptr(
            context.cast(builder, args[0], address_type, types.uint64), ir.IntType(64).as_pointer()
        )
        return builder.atomic_rmw("add", pointer, context.cast(builder, args[1], value_type, types.int64), "monotonic")

    return types.int64(address, value), codegen


@intrinsic
def pointer(typingctx: Any, address: Any) -> Any:
    """Address (uint64) -> void pointer, for `numba.carray` and external functions."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.inttoptr(context.cast(builder, args[0], signature.args[0], types.uint64), cgutils.voidptr_t)

    return types.voidptr(address), codegen
