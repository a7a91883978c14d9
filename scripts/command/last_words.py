"""What a process still says where native code crashes it: one line on stderr, and an exit status, in place of a
signal's."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from typing import Any

CRASHES = () if os.name == "nt" else (signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT, signal.SIGFPE, signal.SIGILL)
_I32, _I64 = 32, 64


@contextmanager
def last_words(line: str, status: int) -> Iterator[None]:
    """Where native code crashes within the block, the process writes a line to what is stderr now and ends with this
    status.

    Blender's readers crash on some damaged files, and where memory is refused libraries crash, or end the process: no
    exception tells. Nothing is done on Windows, nor where LLVM has no memory itself.
    """
    machine = _machine() if CRASHES else None
    if machine is None:
        yield
        return
    stream = os.dup(2)  # Blender's chatter is muted by redirecting 2
    before, words = machine.told(), ctypes.create_string_buffer(f"{line}\n".encode())
    machine.tell(ctypes.addressof(words), len(words) - 1, status, stream)
    handlers = [machine.library.signal(number, machine.handler) for number in CRASHES]
    try:
        yield
    finally:
        for number, handler in zip(CRASHES, handlers, strict=True):
            machine.library.signal(number, handler)
        machine.tell(*before)
        os.close(stream)


def nothing_more(status: int) -> None:
    """Whatever crashes from now on, while the process ends, it ends with this status; and nothing more goes to stderr:
    all is said.

    Blender's own end crashes where there is no memory, and complains before.
    """
    with suppress(OSError, ValueError):  # a stream that is closed
        sys.stderr.flush()
    with suppress(OSError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 2)
        os.close(nowhere)
    machine = _machine() if CRASHES else None
    if machine is not None:
        machine.tell(0, 0, status, 2)
        for number in CRASHES:
            machine.library.signal(number, machine.handler)


class _Machine:
    """A signal handler that runs no Python: the thread that crashes may hold anything. It calls write and _exit, as
    handlers may (POSIX.1-2017, 2.4.3)."""

    def __init__(self) -> None:
        import llvmlite.binding as llvm
        from llvmlite import ir

        i32, i64, module = ir.IntType(_I32), ir.IntType(_I64), ir.Module("last_words")
        self.names = {"words": i64, "length": i64, "status": i32, "stream": i32}
        stored = {}
        for name, kind in self.names.items():
            stored[name] = ir.GlobalVariable(module, kind, f"lipac_{name}")
            stored[name].initializer = ir.Constant(kind, 0)
        write = ir.Function(module, ir.FunctionType(i64, (i32, ir.IntType(8).as_pointer(), i64)), "write")
        end = ir.Function(module, ir.FunctionType(ir.VoidType(), (i32,)), "_exit")
        handler = ir.Function(module, ir.FunctionType(ir.VoidType(), (i32,)), "lipac_last_words")
        builder = ir.IRBuilder(handler.append_basic_block())
        words, length, status, stream = (builder.load(stored[name]) for name in self.names)
        crash = builder.icmp_signed("!=", handler.args[0], ir.Constant(i32, 0))  # else a library calls exit
        told = builder.icmp_signed("!=", stream, ir.Constant(i32, 0))
        with builder.if_then(
            builder.and_(told, builder.or_(crash, builder.icmp_signed("!=", length, ir.Constant(i64, 0))))
        ):
            builder.call(write, (stream, builder.inttoptr(words, ir.IntType(8).as_pointer()), length))
            builder.call(end, (status,))
        builder.ret_void()
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        self.engine = llvm.create_mcjit_compiler(
            llvm.parse_assembly(str(module)), llvm.Target.from_default_triple().create_target_machine()
        )
        self.engine.finalize_object()
        self.handler = self.engine.get_function_address("lipac_last_words")
        kinds: dict[int, Any] = {_I32: ctypes.c_int32, _I64: ctypes.c_int64}
        self.values = [
            kinds[kind.width].from_address(self.engine.get_global_value_address(f"lipac_{name}"))
            for name, kind in self.names.items()
        ]
        self.library = ctypes.CDLL(None)
        self.library.signal.argtypes, self.library.signal.restype = (ctypes.c_int, ctypes.c_void_p), ctypes.c_void_p
        # libraries that get no memory call exit, too
        getattr(self.library, "__cxa_atexit")(ctypes.c_void_p(self.handler), None, None)

    def told(self) -> tuple[int, ...]:
        """What it would do."""
        return tuple(value.value for value in self.values)

    def tell(self, *what: int) -> None:
        """What to do: address and length of the words, status, file descriptor."""
        for value, number in zip(self.values, what, strict=True):
            value.value = number


@cache
def _machine() -> _Machine | None:
    try:
        return _Machine()
    except (OSError, RuntimeError, MemoryError, ImportError):
        return None
