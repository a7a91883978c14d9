"""Reading NumPy buffers by address inside compiled kernels.

Meshes come and go while kernels keep their types: a kernel gets tables of addresses instead of arrays, so no scene
compiles anything again. Whoever fills a table keeps the arrays alive.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray


def address(array: NDArray[Any]) -> int:
    """Address of the first element of a C-contiguous array, 0 for an empty one.

    Raises:
        ValueError: the array is not C-contiguous.
    """
    if not array.flags.c_contiguous:
        raise ValueError("an array read by address must be C-contiguous")
    return int(array.ctypes.data) if array.size else 0


def _loader(name: str, result: Any, stored: ir.Type, doc: str) -> Any:
    def typing(typingctx: Any, base: Any, index: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            pointer = builder.inttoptr(args[0], stored.as_pointer())
            return builder.load(builder.gep(pointer, [args[1]]))

        return result(types.uint64, types.int64), codegen

    typing.__name__ = typing.__qualname__ = name
    typing.__doc__ = doc
    return intrinsic(typing)


load_f32 = _loader("load_f32", types.float32, ir.FloatType(), "float32 number `index` of the buffer at address `base`.")
load_i32 = _loader("load_i32", types.int32, ir.IntType(32), "int32 number `index` of the buffer at address `base`.")
load_u32 = _loader("load_u32", types.uint32, ir.IntType(32), "uint32 number `index` of the buffer at address `base`.")
load_u16 = _loader("load_u16", types.uint16, ir.IntType(16), "uint16 number `index` of the buffer at address `base`.")
load_u8 = _loader("load_u8", types.uint8, ir.IntType(8), "uint8 number `index` of the buffer at address `base`.")
load_i64 = _loader("load_i64", types.int64, ir.IntType(64), "int64 number `index` of the buffer at address `base`.")
load_u64 = _loader("load_u64", types.uint64, ir.IntType(64), "uint64 number `index` of the buffer at address `base`.")


def _pointer(name: str, element: Any, doc: str) -> Any:
    result = types.CPointer(element)

    def typing(typingctx: Any, base: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.inttoptr(args[0], context.get_value_type(result))

        return result(types.uint64), codegen

    typing.__name__ = typing.__qualname__ = name
    typing.__doc__ = doc
    return intrinsic(typing)


# Pointers index like arrays, but own nothing: handing one from function to function counts no references (which costs,
# and is atomic).
f32_pointer = _pointer("f32_pointer", types.float32, "Pointer to the float32 numbers at an address.")
f64_pointer = _pointer("f64_pointer", types.float64, "Pointer to the float64 numbers at an address.")
i32_pointer = _pointer("i32_pointer", types.int32, "Pointer to the int32 numbers at an address.")
i64_pointer = _pointer("i64_pointer", types.int64, "Pointer to the int64 numbers at an address.")
u32_pointer = _pointer("u32_pointer", types.uint32, "Pointer to the uint32 numbers at an address.")
u64_pointer = _pointer("u64_pointer", types.uint64, "Pointer to the uint64 numbers at an address.")


def offset(dtype: np.dtype[Any], name: str) -> np.uint64:
    """Byte offset of a field of a record dtype, for `load_*(record + offset, 0)`."""
    fields = dtype.fields
    assert fields is not None
    return np.uint64(fields[name][1])
