"""Lists of the kernels that a command calls, with the types of their arguments, so that they can be compiled early.

An entry of a list is a line such as `marey.cameras.lens.undistort(float64[:, ::1], float64[::1], int64)`: the full
name of the kernel and the types of its arguments in Numba's notation. `float64[:, ::1]` is an array in C order,
`float64[::1, :]` one in Fortran's order, and `float64[:, :]` one of any strides. A tuple is `(int64, bool)`; a named
tuple is the full name of its class and the types of its fields.
"""

import ast
import importlib
import sys
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Literal

from numba.core import types
from numba.core.types.containers import BaseTuple

_HEAD = "# Written by `python -m bench run speed/compilation --write-lists`; do not edit.\n"
"""First line of a file with a list."""


@dataclass(frozen=True, slots=True)
class ListedKernel:
    """A kernel that Python calls, and the types of its arguments.

    Attributes:
        name: Full name of the kernel: its module and its name in the module.
        arguments: Numba's types of its arguments.
    """

    name: str
    arguments: tuple[Any, ...]

    @property
    def dispatcher(self) -> Any:
        """The kernel; its module is imported.

        Raises:
            AttributeError: The module has no such kernel.
        """
        return _named(self.name)

    @property
    def is_missing(self) -> bool:
        """Whether it is compiled at its first call, which takes long.

        It is not where Numba is switched off, and not known where Numba keeps its own cache.
        """
        is_kept = getattr(self.dispatcher, "is_kept", None)
        return is_kept is not None and not is_kept(self.arguments)

    def __str__(self) -> str:
        """Write the entry of a list."""
        return f"{self.name}({', '.join(type_text(kind) for kind in self.arguments)})"

    @classmethod
    def parsed(cls, text: str) -> "ListedKernel":
        """Read the entry of a list.

        Args:
            text: The entry, as `str` gives it.

        Returns:
            The kernel.

        Raises:
            ValueError: The text is not an entry.
        """
        call = ast.parse(text, mode="eval").body
        if not isinstance(call, ast.Call):
            raise ValueError(f"{text!r} is not a kernel with the types of its arguments")
        return cls(ast.unparse(call.func), tuple(_type_of(part) for part in call.args))


def listed_kernels(name: str) -> list[ListedKernel]:
    """Read a list of the package.

    Args:
        name: Name of the list, for example "capture".

    Returns:
        The kernels, in the order in which the command calls them for the first time.

    Raises:
        FileNotFoundError: There is no such list.
    """
    text = (files("marey.compiled") / "lists" / f"{name}.toml").read_text(encoding="utf-8")
    return [ListedKernel.parsed(entry) for entry in tomllib.loads(text)["kernels"]]


def list_text(kernels: Iterable[ListedKernel]) -> str:
    """Write a list as the content of a file.

    Args:
        kernels: The kernels, in the order of their first calls.

    Returns:
        TOML with one entry per line.
    """
    lines = "".join(f'  "{kernel}",\n' for kernel in kernels)
    return f"{_HEAD}kernels = [\n{lines}]\n"


def type_text(kind: Any) -> str:
    """Write a type of Numba in the notation of the lists.

    Args:
        kind: A number, an array of numbers, or a tuple or named tuple of such types.

    Returns:
        The text.

    Raises:
        ValueError: A list cannot contain this type.
    """
    if isinstance(kind, types.Boolean):
        return "bool"
    if isinstance(kind, types.Array):
        every = [":"] * kind.ndim
        if kind.layout != "A":
            every[-1 if kind.layout == "C" else 0] = "::1"
        return f"{type_text(kind.dtype)}[{', '.join(every)}]"
    if isinstance(kind, BaseTuple):
        parts = ", ".join(type_text(part) for part in kind.types)
        owner = getattr(kind, "instance_class", None)
        if owner is not None:
            return f"{owner.__module__}.{owner.__qualname__}({parts})"
        return f"({parts},)" if len(kind.types) == 1 else f"({parts})"
    if isinstance(kind, types.Number) and getattr(types, str(kind), None) == kind:
        return str(kind)
    raise ValueError(f"a list of kernels cannot contain the type {kind}")


def _type_of(text: ast.expr) -> Any:
    """Read a type in the notation of the lists."""
    match text:
        case ast.Name(id="bool"):
            return types.boolean
        case ast.Name(id=name) if isinstance(getattr(types, name, None), types.Number):
            return getattr(types, name)
        case ast.Subscript(value=element, slice=index):
            axes = index.elts if isinstance(index, ast.Tuple) else [index]
            steps = [isinstance(axis, ast.Slice) and axis.step is not None for axis in axes]
            layout: Literal["C", "F", "A"] = "C" if steps[-1] else "F" if steps[0] else "A"
            return types.Array(_type_of(element), len(axes), layout)
        case ast.Tuple(elts=parts):
            return BaseTuple.from_types(tuple(_type_of(part) for part in parts))
        case ast.Call(func=owner, args=parts):
            return BaseTuple.from_types(tuple(_type_of(part) for part in parts), _named(ast.unparse(owner)))
    raise ValueError(f"{ast.unparse(text)!r} is not a type of a kernel's argument")


def _named(name: str) -> Any:
    """Find an object by its full name."""
    module, _, own = name.rpartition(".")
    return getattr(sys.modules.get(module) or importlib.import_module(module), own)
