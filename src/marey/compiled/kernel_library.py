"""The code of a compiled kernel, translated to machine code only where Python calls the kernel.

When Numba compiles a function, it optimises the function and translates it to machine code, even if only other kernels
call it. These contain its code and optimise it again, and only their machine code is used.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import llvmlite.binding as llvm
from numba.core.codegen import JITCodeLibrary
from numba.core.environment import lookup_environment

_ENVIRONMENT = "_ZN08NumbaEnv"
"""How the names of variables begin that hold the address of a function's constants; see Numba's `Environment`."""

_ENTRY_INTO_NUMBA = "_ZN7cpython5numba"
"""How the names of entry points into functions of Numba begin, which Python never calls: `np.empty` and so on."""

_LINKED = "linked code"
"""Kind of a saved library without machine code, beside Numba's `bitcode` and `object`."""


class KernelLibrary(JITCodeLibrary):
    """Numba's library of the code of one function, without machine code until `finalize` is called.

    Its code, together with that of all functions it calls, can be linked into other libraries before.
    """

    @property
    def has_machine_code(self) -> bool:
        """Whether the code was optimised and translated."""
        return bool(self._finalized)

    @property
    def codegen(self) -> Any:
        """Numba's generator of machine code; one without addresses of constants as long as there is no machine code."""
        return self._codegen if self._finalized else _WITHOUT_ENVIRONMENTS

    @property
    def has_dynamic_globals(self) -> bool:
        """Whether the code contains addresses that hold for this process only."""
        return any(found.name.startswith("numba.dynamic.globals") for found in self._final_module.global_variables)

    def finalize(self) -> None:
        """Optimise the code and translate it to machine code."""
        self._link()
        # The copy for other libraries lacks the entry point for Python. It is made again, with it, where it is saved.
        self._shared_module = None
        super().finalize()
        for variable in self._final_module.global_variables:
            environment = lookup_environment(variable.name) if variable.name.startswith(_ENVIRONMENT) else None
            if environment is not None:
                self._codegen.set_env(variable.name, environment)

    def add_linking_library(self, library: Any) -> None:
        """Let this library contain the code of another one.

        Args:
            library: The other library; Numba's own are finalised.
        """
        if isinstance(library, KernelLibrary):
            library._link()
        else:
            library._ensure_finalized()
        self._linking_libraries.append(library)

    def get_pointer_to_function(self, name: str) -> int:
        """Give the address of a function; 0 if the library does not contain it, or has no machine code.

        A kernel has no entry point for Python before its dispatcher adds one. Where a kernel calls a function that
        the user compiled by `numba.njit`, that function has one, and gets its machine code here.
        """
        if not self._finalized and not name.startswith(_ENTRY_INTO_NUMBA) and self._contains(name):
            self.finalize()
        return super().get_pointer_to_function(name) if self._finalized else 0

    def serialize_using_object_code(self) -> Any:
        """Give the content to be saved: with the machine code if there is any."""
        if self._finalized:
            return super().serialize_using_object_code()
        self._link()
        return self.name, _LINKED, self._final_module.as_bitcode()

    @classmethod
    def _unserialize(cls, codegen: Any, state: Any) -> Any:
        name, kind, data = state
        if kind != _LINKED:
            return super()._unserialize(codegen, state)
        library = codegen.create_library(name)
        library.enable_object_caching()
        library._final_module = llvm.parse_bitcode(data)
        return library

    def _contains(self, name: str) -> bool:
        return any(function.name == name and not function.is_declaration for function in self._final_module.functions)

    def _ensure_finalized(self) -> None:
        """Prepare to be contained in another library; Numba's method would translate this one to machine code."""
        self._link()

    def _link(self) -> None:
        """Add the code of the functions that are called."""
        for library in dict.fromkeys(self._linking_libraries):
            if hasattr(library, "_reload_init"):  # Numba 0.63 and newer.
                self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._linking_libraries.clear()

    def _optimize_functions(self, ll_module: Any) -> None:
        """Optimise each function by itself; unlike Numba's method, leave out those that are only declared."""
        ll_module.data_layout = self._codegen._data_layout
        for function in ll_module.functions:
            if not function.is_declaration:
                manager, builder = self._codegen._function_pass_manager()
                manager.run(function, builder)

    def _get_module_for_linking(self) -> Any:
        """Give a copy of the code whose functions other libraries may contain too."""
        self._link()
        if self._shared_module is None:
            shared = self._final_module.clone()
            for function in shared.functions:
                if not function.is_declaration and function.linkage == llvm.Linkage.external:
                    function.linkage = llvm.Linkage.linkonce_odr
            self._shared_module = shared
        return self._shared_module


class _WithoutEnvironments:
    """Stands for a generator of machine code where there is none whose constants could get an address."""

    def set_env(self, name: str, environment: Any) -> None:
        """Do nothing: `KernelLibrary.finalize` sets the address."""


_WITHOUT_ENVIRONMENTS = _WithoutEnvironments()
"""The generator of libraries without machine code."""


def has_entry_point(compiled: Any) -> bool:
    """Return whether a kernel can be called from Python.

    Args:
        compiled: Numba's `CompileResult`.

    Returns:
        Whether there is machine code.
    """
    return not isinstance(compiled.library, KernelLibrary) or compiled.library.has_machine_code


def is_machine_code(saved: tuple[str, str, Any]) -> bool:
    """Return whether a saved library contains machine code.

    Args:
        saved: What `serialize_using_object_code` has given: name, kind and content.

    Returns:
        Whether it does.
    """
    return saved[1] != _LINKED


@contextmanager
def kernel_libraries(codegen: Any) -> Iterator[None]:
    """Let Numba create kernel libraries; other functions, compiled outside of the block, get Numba's own.

    Args:
        codegen: Numba's generator of machine code. The caller holds Numba's lock of the compiler.

    Yields:
        Nothing.
    """
    before = codegen._library_class
    codegen._library_class = KernelLibrary
    try:
        yield
    finally:
        codegen._library_class = before
