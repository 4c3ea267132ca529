"""Which arguments a compiled kernel may write to, found in the typed intermediate representation of Numba."""

from collections.abc import Iterator
from typing import Any

from numba.core import ir, types
from numba.core.types.containers import BaseTuple
from numba.core.types.misc import NoneType

WRITTEN = "marey_written"
"""Key, in the metadata of Numba's `CompileResult`, of the arguments that a kernel may write to."""

_READING_METHODS = frozenset(
    ["all", "any", "argmax", "argmin", "argsort", "astype", "copy", "cumsum", "dot", "flatten", "item", "max", "mean"]
    + ["min", "nonzero", "prod", "ravel", "reshape", "std", "sum", "transpose", "var", "view"]
)
"""Methods of arrays that do not write to the array."""

_SHARING_METHODS = frozenset({"astype", "ravel", "reshape", "transpose", "view"})
"""Methods among them whose result may be the array itself, or a part of it."""

_READING_MODULES = frozenset({"builtins", "math", "numpy"})
"""Packages whose functions write to no argument that is given by position."""


def written_arguments(annotation: Any, count: int) -> frozenset[int]:
    """Find the arguments that a kernel may write to, or return.

    A variable that may share memory with an argument is treated as the argument, wherever it is assigned; a call of an
    unknown function is treated as one that writes. An intrinsic states by its attribute `written` the numbers of the
    arguments that it writes to. So the result may contain too many arguments, but not too few.

    Args:
        annotation: Numba's `TypeAnnotation` of the compiled kernel.
        count: Number of arguments of the kernel.

    Returns:
        Numbers of the arguments.
    """
    statements = [statement for block in annotation.blocks.values() for statement in block.body]
    sources = _sources(statements, annotation)
    written: set[int] = set()
    for statement in statements:
        for name in _written_variables(statement, annotation):
            written |= sources.get(name, set())
    return frozenset(number for number in written if number < count)


def _sources(statements: list[Any], annotation: Any) -> dict[str, set[int]]:
    """Find the arguments with which each variable may share memory."""
    sources: dict[str, set[int]] = {}
    assignments = [statement for statement in statements if isinstance(statement, ir.Assign)]
    is_changed = True
    while is_changed:
        is_changed = False
        for assignment in assignments:
            name, value = assignment.target.name, assignment.value
            if _is_value(annotation.typemap.get(name)):
                continue
            found = {value.index} if isinstance(value, ir.Arg) else set()
            for variable in _variables(value, annotation):
                found |= sources.get(variable, set())
            if not found <= sources.setdefault(name, set()):
                sources[name] |= found
                is_changed = True
    return sources


def _is_value(kind: Any) -> bool:
    """Return whether variables of a type share no memory with others: numbers, and tuples of them."""
    if isinstance(kind, BaseTuple):
        return all(_is_value(part) for part in kind)
    return isinstance(kind, types.Number | types.Boolean | NoneType | types.EnumMember)


def _variables(value: Any, annotation: Any) -> Iterator[str]:
    """Give the variables with which the result of an expression may share memory."""
    if isinstance(value, ir.Var):
        yield value.name
    elif _calls_kernel(value, annotation):
        yield from _written_by_call(value, annotation)  # What a kernel returns is among these.
    elif _is_copy(value, annotation):
        return
    elif isinstance(value, ir.Expr):
        yield from (variable.name for variable in value.list_vars())


def _written_variables(statement: Any, annotation: Any) -> Iterator[str]:
    """Give the variables that a statement may write to, or return."""
    if isinstance(statement, ir.SetItem | ir.StaticSetItem | ir.SetAttr | ir.DelItem):
        yield statement.target.name
    elif isinstance(statement, ir.Return | ir.Yield):
        yield statement.value.name
    elif isinstance(statement, ir.Assign) and isinstance(statement.value, ir.Expr):
        value = statement.value
        if value.op == "inplace_binop":
            yield value.lhs.name
        elif value.op == "call":
            yield from _written_by_call(value, annotation)


def _written_by_call(call: Any, annotation: Any) -> Iterator[str]:
    function = annotation.typemap[call.func.name]
    keywords = dict(call.kws)
    if _calls_kernel(call, annotation):
        dispatcher = function.dispatcher
        signature = annotation.calltypes[call]
        written = getattr(dispatcher, "written", {}).get(tuple(signature.args))
        parameters = dispatcher._compiler.pysig.parameters
        given = dict(zip(parameters, call.args, strict=False)) | keywords
        for number, name in enumerate(parameters):
            if name in given and (written is None or number in written):
                yield given[name].name
    elif isinstance(function, types.BoundFunction):
        if _method(function) not in _READING_METHODS:
            yield from (variable.name for variable in call.list_vars())
    elif (stated := getattr(getattr(function, "typing_key", None), "written", None)) is not None:
        yield from (call.args[number].name for number in stated)
    elif _is_reading(function):
        if "out" in keywords:
            yield keywords["out"].name
    else:
        yield from (variable.name for variable in call.list_vars())


def _calls_kernel(value: Any, annotation: Any) -> bool:
    """Return whether an expression is a call of another compiled function whose arguments are known one by one."""
    if not (isinstance(value, ir.Expr) and value.op == "call" and value.vararg is None):
        return False
    return isinstance(annotation.typemap[value.func.name], types.Dispatcher)


def _is_copy(value: Any, annotation: Any) -> bool:
    """Return whether an expression is an array of its own: one of selected elements, or the result of a method."""
    if not isinstance(value, ir.Expr):
        return False
    if value.op == "getitem":
        return isinstance(annotation.typemap[value.index.name], types.Array)
    function = annotation.typemap[value.func.name] if value.op == "call" else None
    return isinstance(function, types.BoundFunction) and _method(function) in _READING_METHODS - _SHARING_METHODS


def _method(function: types.BoundFunction) -> str:
    """Name of a method of an array."""
    key = function.template.key
    return str(key[-1]) if isinstance(key, tuple) else str(key).rpartition(".")[2]


def _is_reading(function: Any) -> bool:
    """Return whether a function is a type, a named tuple, or one of the packages known to write to no argument."""
    if isinstance(function, types.NumberClass | types.NamedTupleClass):
        return True
    if not isinstance(function, types.Function):
        return False
    key = function.typing_key
    module = getattr(key, "__module__", None) or type(key).__module__
    return module.partition(".")[0] in _READING_MODULES and "random" not in module
