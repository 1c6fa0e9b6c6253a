"""Functions that only kernels call are linked into these, without machine code of their own.

numba compiles each function that a kernel calls as if Python called it, too. Here, what is compiled on the way to a
kernel of this package stays LLVM code; the kernel is linked from all of it and optimised once. The arithmetic is the
same: without ``fastmath`` no optimisation changes what is rounded.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numba
from numba.core import codegen, cpu, dispatcher, sigutils
from numba.core.compiler_lock import global_compiler_lock

# other versions may lack them
_Compiler: Any = getattr(dispatcher, "_FunctionCompiler", None)
_Dispatcher: Any = getattr(dispatcher, "Dispatcher", None)
_Base: Any = getattr(dispatcher, "_DispatcherBase", None)
_Codegen: Any = getattr(codegen, "Codegen", None)
_Library: Any = getattr(codegen, "CPUCodeLibrary", None)
_Context: Any = getattr(cpu, "CPUContext", None)

#: The versions of numba whose parts are replaced: those that this was tried with.
_TRIED = "0.68."
#: What they have.
_NEEDED = (
    (_Compiler, "_compile_core"), (_Compiler, "_customize_flags"), (_Dispatcher, "compile"), (_Base, "add_overload"),
    (_Codegen, "create_library"), (_Library, "finalize"), (_Context, "get_executable"),
)  # fmt: skip


class LinkedOnly:
    """Placeholder, in numba's tables, for the address of a function without machine code."""


@dataclass
class _Compilation:
    """The compilation under way, which numba's lock lets one thread have at a time.

    Attributes:
        depth: Functions that are being compiled, each for the one before it; the first is a kernel of this package.
    """

    depth: int = 0
    done: Callable[[], object] = lambda: None


_compilation = _Compilation()


def within_kernel() -> bool:
    """Whether a kernel of this package is being compiled; asked under numba's lock."""
    return _compilation.depth > 0


def _linked_only(result: Any) -> bool:
    return isinstance(result.entry_point, LinkedOnly)


def install(done: Callable[[], object]) -> None:
    """Make numba link kernels as this module describes, if its version has the parts that are replaced.

    ``done`` is called after each compiled function.
    """
    if not numba.__version__.startswith(_TRIED) or not all(hasattr(owner, name) for owner, name in _NEEDED):
        return
    _compilation.done = done
    originals = {(owner, name): getattr(owner, name) for owner, name in _NEEDED}

    def compile_core(compiler: Any, args: Any, return_type: Any) -> Any:
        compiled = originals[_Compiler, "_compile_core"]
        if _compilation.depth == 0 and not compiler.py_func.__module__.startswith("ns_abstract."):
            return compiled(compiler, args, return_type)
        _compilation.depth += 1
        try:
            with _uncollected():
                result = compiled(compiler, args, return_type)
        finally:
            _compilation.depth -= 1
        _compilation.done()
        return result

    def customize_flags(compiler: Any, flags: Any) -> Any:
        flags = originals[_Compiler, "_customize_flags"](compiler, flags)
        if _compilation.depth > 1:
            flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
        return flags

    def compile_signature(kernel: Any, signature: Any) -> Any:
        with global_compiler_lock:
            args = tuple(sigutils.normalize_signature(signature)[0])
            overload = kernel.overloads.get(args)
            if overload is not None and _linked_only(overload) and _compilation.depth == 0:
                # Python calls it now
                del kernel.overloads[args]
            return originals[_Dispatcher, "compile"](kernel, signature)

    def add_overload(kernel: Any, result: Any) -> None:
        if _linked_only(result):
            kernel.overloads[tuple(result.signature.args)] = result
        else:
            originals[_Base, "add_overload"](kernel, result)

    def create_library(owner: Any, name: str, **options: Any) -> Any:
        library = originals[_Codegen, "create_library"](owner, name, **options)
        library.linked_only = _compilation.depth > 1
        return library

    def finalize(library: Any) -> None:
        if library.linked_only:
            library._raise_if_finalized()
            library._finalized = True
            return
        library._linking_libraries = _all_linked(library)
        originals[_Library, "finalize"](library)

    def get_executable(context: Any, library: Any, *more: Any) -> Any:
        return LinkedOnly() if library.linked_only else originals[_Context, "get_executable"](context, library, *more)

    replaced = (
        compile_core, customize_flags, compile_signature, add_overload, create_library, finalize, get_executable
    )  # fmt: skip
    _Library.linked_only = False
    for (owner, name), function in zip(_NEEDED, replaced, strict=True):
        setattr(owner, name, function)


@contextmanager
def _uncollected() -> Iterator[None]:
    """Return a context without garbage collection, as a compilation makes millions of objects and keeps them."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _all_linked(library: Any) -> list[Any]:
    """Return libraries that ``library`` needs, each before those it needs itself: LLVM links only called functions."""
    libraries: dict[Any, None] = {}

    def visit(other: Any) -> None:
        if other not in libraries:
            if other.linked_only or other is library:
                for next_one in reversed(other._linking_libraries):
                    visit(next_one)
            libraries[other] = None

    visit(library)
    return list(reversed(libraries))[1:]
