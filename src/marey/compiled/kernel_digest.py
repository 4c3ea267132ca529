"""A digest of all that determines a kernel's machine code, taken from its content and not from its file.

The digest covers the bytecode that Numba compiles, the options of the decorator and, through the names that the
bytecode loads, every other kernel, intrinsic, function, and constant that the kernel uses, in any module it is
defined. Comments, docstrings, line numbers, and the place of the file are not part of bytecode and do not matter.
"""

import dis
import enum
import functools
import hashlib
import sys
from collections.abc import Callable, Iterator
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
from numba.core.dispatcher import Dispatcher

_PLAIN = (type(None), type(...), bool, int, float, complex, str, bytes)
"""Types whose `repr` determines the value."""

_VERSIONED = frozenset({"numpy", "numba", "llvmlite"}) | sys.stdlib_module_names
"""Packages whose content is determined by the versions that the cache's key names; they enter a digest by name."""

_VARIADIC = 0x04 | 0x08
"""Bits of a code object's flags that mark *args and **kwargs."""


class UnknownContentError(TypeError):
    """A kernel uses an object whose content cannot be part of a digest."""


def kernel_digest(function: Callable[..., Any], options: dict[str, Any]) -> str:
    """Compute a digest of a kernel and, transitively, of all that it uses.

    The values of module constants are read at the time of the call, as Numba reads them when it compiles.

    Args:
        function: Python function of the kernel.
        options: Options of its decorator.

    Returns:
        64 hexadecimal digits.

    Raises:
        UnknownContentError: The kernel uses an object of a kind that is not supported, for example an instance of a
            class that is neither a number, an array, nor a tuple of these.
    """
    digest = hashlib.sha256()
    walk = _Walk()
    walk.number_of(function, options)
    for found, its_options in walk.functions:  # Grows in the loop.
        digest.update(repr(_function_content(walk, found, its_options)).encode())
    return digest.hexdigest()


def class_content(kind: type) -> tuple[Any, ...]:
    """Describe a class that kernels can use: a named tuple, an enumeration, an exception, or one of a library.

    Raises:
        UnknownContentError: The class is of another kind.
    """
    name = f"{kind.__module__}.{kind.__qualname__}"
    if _is_versioned(kind.__module__) or issubclass(kind, BaseException):
        return ("class", name)
    if issubclass(kind, tuple) and hasattr(kind, "_fields"):
        return ("named tuple", name, kind._fields)
    if issubclass(kind, enum.Enum):
        return ("enumeration", name, [(member.name, repr(member.value)) for member in kind])
    raise UnknownContentError(f"class {name}")


class _Walk:
    """Functions met so far; each is referred to by its number, so that recursion comes to an end."""

    def __init__(self) -> None:
        self.functions: list[tuple[Callable[..., Any], dict[str, Any]]] = []
        self._numbers: dict[int, int] = {}

    def number_of(self, function: Callable[..., Any], options: dict[str, Any]) -> int:
        if id(function) not in self._numbers:
            self._numbers[id(function)] = len(self.functions)
            self.functions.append((function, options))
        return self._numbers[id(function)]


def _function_content(walk: _Walk, function: Any, options: dict[str, Any]) -> tuple[Any, ...]:
    text, chains = _code_content(function.__code__)
    cells = function.__closure__ or ()
    return (
        function.__module__,
        function.__qualname__,
        _content(walk, options),
        _content(walk, function.__defaults__),
        _content(walk, function.__kwdefaults__),
        [_content(walk, cell.cell_contents) for cell in cells],
        text,
        [(chain, _global_content(walk, function, chain)) for chain in chains],
    )


@functools.cache
def _code_content(code: CodeType) -> tuple[str, tuple[tuple[str, ...], ...]]:
    """Describe bytecode without its lines and docstring.

    Returns:
        The description, and the globals that it loads, each with the attributes that it takes of them at once:
        `rotations.rotate` gives ("rotations", "rotate").
    """
    steps: list[tuple[str, Any]] = []
    chains: list[tuple[str, ...]] = []
    in_chain = False
    for step in dis.get_instructions(code):
        if step.opname == "EXTENDED_ARG":
            continue
        argument: Any = step.arg
        if step.opcode in dis.hasname or step.opcode in dis.hasjrel or step.opcode in dis.hasjabs:
            argument = step.argval
        elif step.opcode in dis.hasconst:
            argument = _constant_content(step.argval, chains)
        steps.append((step.opname, argument))
        if step.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
            chains.append((step.argval,))
            in_chain = True
        elif in_chain and step.opname in ("LOAD_ATTR", "LOAD_METHOD"):
            chains[-1] += (step.argval,)
        else:
            in_chain = False
    signature = (code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags & _VARIADIC)
    names = (code.co_name, code.co_varnames, code.co_cellvars, code.co_freevars)
    return repr((signature, names, steps, code.co_exceptiontable)), tuple(dict.fromkeys(chains))


def _constant_content(value: Any, chains: list[tuple[str, ...]]) -> Any:
    """Describe a constant of bytecode; the globals that a nested function loads are added to `chains`."""
    if isinstance(value, CodeType):
        text, nested = _code_content(value)
        chains.extend(nested)
        return text
    return _content(_Walk(), value)


def _global_content(walk: _Walk, function: Any, chain: tuple[str, ...]) -> Any:
    """Describe a global; attributes are followed through modules of unversioned packages only."""
    name, *attributes = chain
    builtins = function.__globals__.get("__builtins__", {})
    names = builtins if isinstance(builtins, dict) else vars(builtins)
    if name not in function.__globals__ and name not in names:
        return "missing"
    value = function.__globals__.get(name, names.get(name))
    for attribute in attributes:
        if not isinstance(value, ModuleType) or _is_versioned(value.__name__):
            break
        if not hasattr(value, attribute):
            return "missing"
        value = getattr(value, attribute)
    try:
        return _content(walk, value)
    except UnknownContentError as problem:
        place = f"{function.__module__}.{function.__qualname__}"
        raise UnknownContentError(f"{place} uses {'.'.join(chain)}, which is {problem}") from None


def _content(walk: _Walk, value: Any) -> Any:
    """Describe a value by nested tuples whose `repr` is the same in every process."""
    if type(value) in _PLAIN:
        return (type(value).__name__, repr(value))
    if isinstance(value, enum.Enum):
        return (class_content(type(value)), value.name)
    if isinstance(value, np.ndarray | np.generic):
        return _array_content(value)
    if isinstance(value, tuple | list | set | frozenset | dict | slice):
        return _collection_content(walk, value)
    if isinstance(value, type):
        return class_content(value)
    return _callable_content(walk, value)


def _array_content(value: np.ndarray | np.generic) -> Any:
    if value.dtype.hasobject:
        raise UnknownContentError("an array of Python objects")
    layout = (value.flags.c_contiguous, value.flags.f_contiguous)
    return ("array", repr(value.dtype), value.shape, layout, hashlib.sha256(value.tobytes()).hexdigest())


def _collection_content(walk: _Walk, value: Any) -> Any:
    if isinstance(value, slice):
        return ("slice", [_content(walk, part) for part in (value.start, value.stop, value.step)])
    kind = type(value).__name__ if type(value).__module__ == "builtins" else class_content(type(value))
    parts: Iterator[Any] = iter(value.items() if isinstance(value, dict) else value)
    contents = [_content(walk, part) for part in parts]
    return (kind, contents if isinstance(value, tuple | list) else sorted(contents, key=repr))


def _callable_content(walk: _Walk, value: Any) -> Any:
    """Describe a kernel, an intrinsic, a function, or an object of a versioned package."""
    if isinstance(value, Dispatcher):
        return ("kernel", walk.number_of(value.py_func, dict(value.targetoptions)))
    kind = type(value)
    if kind.__name__ == "_Intrinsic":
        return ("intrinsic", walk.number_of(value._defn, {}))
    home = getattr(value, "__module__", None) or ""
    if isinstance(value, ModuleType):
        if _is_versioned(value.__name__):
            return ("module", value.__name__)
    elif isinstance(value, BuiltinFunctionType | FunctionType) and _is_versioned(home):
        return ("function", home, value.__qualname__)
    elif isinstance(value, FunctionType):
        return ("function", walk.number_of(value, {}))
    elif _is_versioned(kind.__module__) and " at 0x" not in str(value):
        return ("object", kind.__module__, kind.__qualname__, str(value))
    raise UnknownContentError(f"an object of type {kind.__module__}.{kind.__qualname__}")


def _is_versioned(module: str) -> bool:
    return module.partition(".")[0] in _VERSIONED
