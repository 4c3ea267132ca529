"""The dispatcher of a kernel, which compiles one specialisation where Numba's would compile several of the same code.

Numba compiles a function anew for each combination of types of its arguments. Two differences of type change no
machine code: whether an array is read-only, as the arrays of frozen values are, and whether an integer is a literal of
the calling kernel. The dispatcher removes both before it compiles.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event, sigutils, types, typing
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numba.core.types.containers import BaseTuple, StarArgTuple
from numba.core.types.misc import unliteral

from marey.compiled import TRANSLATION
from marey.compiled.kernel_cache import KernelCache
from marey.compiled.kernel_library import has_entry_point, kernel_libraries
from marey.compiled.kernel_writes import WRITTEN, written_arguments


class KernelDispatcher(CPUDispatcher):
    """Numba's dispatcher with fewer specialisations.

    An array that Python passes is compiled as one that can be written to; a call with a read-only array uses the same
    machine code. A literal that a kernel passes to another one is compiled as a variable of its type.

    Read-only arrays stay protected: an argument that the kernel may write to keeps its type, and Numba does not
    compile a kernel that writes to a read-only array.

    Attributes:
        written: For each specialisation, the numbers of the arguments that it may write to or return.
    """

    def __init__(self, py_func: Any, *args: Any, **kwargs: Any):
        self.written: dict[tuple[Any, ...], frozenset[int]] = {}
        self._known: set[tuple[Any, ...]] = set()
        super().__init__(py_func, *args, **kwargs)
        self._cache = KernelCache(self)

    def add_overload(self, cres: Any) -> None:
        """Add a specialisation that was compiled or loaded."""
        kinds = tuple(cres.signature.args)
        if WRITTEN not in cres.metadata:
            cres.metadata[WRITTEN] = written_arguments(cres.type_annotation, len(kinds))
        self.written[kinds] = cres.metadata[WRITTEN]
        if has_entry_point(cres) and kinds not in self._known:
            self._known.add(kinds)
            super().add_overload(cres)
        else:
            self.overloads[kinds] = cres

    def compile(self, sig: Any) -> Any:
        """Compile or load the specialisation for a call from Python.

        Args:
            sig: Types of the arguments, or a signature.

        Returns:
            The entry point of the machine code.
        """
        given, _ = sigutils.normalize_signature(sig)
        uniform = tuple(writable_type(kind) for kind in given)
        if uniform == tuple(given):
            return self._compile_once(uniform, is_entry=True)
        entry = self._compile_once(uniform, is_entry=True)
        kept = tuple(given[i] if i in self.written[uniform] else kind for i, kind in enumerate(uniform))
        if kept != uniform:
            entry = self._compile_once(kept, is_entry=True)
        self._add_entry(tuple(given), entry)
        return entry

    def is_kept(self, kinds: tuple[Any, ...]) -> bool:
        """Return whether the cache holds machine code for a call from Python with arguments of these types."""
        return bool(self._cache.is_kept(kinds, self.targetctx))

    def is_free(self, kinds: tuple[Any, ...]) -> bool:
        """Return whether the cache can keep machine code for these types, and no other process compiles it now."""
        return bool(self._cache.is_free(kinds, self.targetctx))

    def _add_entry(self, kinds: tuple[Any, ...], entry: Any) -> None:
        """Let the next call with arguments of these types find an entry point without Python.

        Each combination of types has one entry: Numba cannot choose between two, and every call would return to
        `compile`. Threads that call a kernel for the first time at the same time all come here.
        """
        with global_compiler_lock:
            if kinds not in self._known:
                self._known.add(kinds)
                self._insert([kind._code for kind in kinds], entry, False)

    def _compile_once(self, kinds: tuple[Any, ...], *, is_entry: bool = False) -> Any:
        """Compile or load a specialisation; another process that needs it at the same time waits and loads it.

        Args:
            kinds: Types of the arguments.
            is_entry: Whether Python calls the kernel, which needs machine code for it.

        Returns:
            The entry point for Python, which may be called if `is_entry`.
        """
        with global_compiler_lock, without_collection(), kernel_libraries(self.targetctx.codegen()):
            self._cache.saves_linked_code = not is_entry
            try:
                super().compile(kinds)
                if is_entry and not has_entry_point(self.overloads[kinds]):
                    self._add_machine_code(kinds)
            finally:
                self._cache.release(kinds)
            return self.overloads[kinds].entry_point

    def _add_machine_code(self, kinds: tuple[Any, ...]) -> None:
        """Translate a specialisation to machine code with an entry point for Python, and save it."""
        # Where this is interrupted, the next call compiles the kernel again.
        linked, context = self.overloads.pop(kinds), self.targetctx.subtarget(enable_nrt=True)
        code = linked.library, linked.fndesc, linked.environment
        with event.trigger_event(TRANSLATION, data={"dispatcher": self, "args": kinds}):
            with context.push_code_library(linked.library):
                context.create_cpython_wrapper(*code, linked.call_helper, release_gil=self.targetoptions["nogil"])
            linked.library.finalize()
        entry = context.get_executable(*code)
        context.insert_user_function(entry, linked.fndesc, [linked.library])
        self.add_overload(linked._replace(entry_point=entry))
        self._cache.save_overload(kinds, self.overloads[kinds])

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Give the template by which another kernel's call of this one is typed; see the base class."""
        pysig, folded = self.fold_argument_types(args, kws)
        variables = tuple(unliteral(kind) for kind in folded)
        if self._can_compile:
            self._compile_once(variables)
        template = typing.make_concrete_template(
            f"CallTemplate({self.py_func.__name__})", key=self.py_func.__name__, signatures=self.nopython_signatures
        )
        return template, pysig, variables, {}


@contextmanager
def without_collection() -> Iterator[None]:
    """Switch Python's collection of unused objects off: it took a sixth of the time of compilation.

    Yields:
        Nothing.
    """
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()


def writable_type(kind: Any) -> Any:
    """Replace the types of read-only arrays, also those in tuples, by those of arrays that can be written to."""
    if isinstance(kind, types.Array):
        return kind if kind.mutable else kind.copy(readonly=False)
    if isinstance(kind, BaseTuple) and not isinstance(kind, StarArgTuple):
        parts = tuple(writable_type(part) for part in kind.types)
        if parts != tuple(kind.types):
            return BaseTuple.from_types(parts, getattr(kind, "instance_class", None))
    return kind
