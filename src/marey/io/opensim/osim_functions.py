"""Reading functions of a coordinate, and numbers, from the XML of OpenSim's models."""

from collections.abc import Callable
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from marey.arrays import Floats
from marey.body.articulation import coordinate_functions as functions
from marey.body.articulation.coordinate_functions import PiecewisePolynomial
from marey.errors import FileProblem, MareyError


def text(element: Element | None, tag: str, default: str = "") -> str:
    """Return the text of a child element without surrounding blanks, or a default if it is missing or empty."""
    return ((element.findtext(tag) if element is not None else None) or "").strip() or default


def truth(element: Element, tag: str, default: bool = False) -> bool:
    """Return the Boolean value of a child element, or a default if it is missing or empty."""
    return text(element, tag, str(default)).lower() in ("true", "1")


def numbers(path: Path | str, element: Element, tag: str, where: str, default: Floats | None = None) -> Floats:
    """Return the numbers of a child element.

    Args:
        path: The file, for error messages.
        element: The parent element.
        tag: Name of the child element.
        where: Object to which the element belongs, for error messages.
        default: Values if the child is missing, which also give the required count; None if the child must exist.

    Returns:
        (n,) numbers.

    Raises:
        FileProblem: The child is missing, or its content is not the right count of finite numbers.
    """
    given = text(element, tag)
    if not given and default is not None:
        return np.asarray(default, float)
    try:
        values = np.array([float(word) for word in given.replace(",", " ").split()])
    except ValueError as error:
        wrong = f"has no numbers in <{tag}> of {where} but {given[:40]!r}"
        raise FileProblem(path, wrong, "Write numbers there.") from error
    count = None if default is None else np.size(default)
    if not len(values) or (count is not None and len(values) != count) or not np.isfinite(values).all():
        remedy = f"Write {f'{count} finite' if count else 'finite'} numbers there."
        raise FileProblem(path, f"has {given[:40]!r} in <{tag}> of {where}", remedy)
    return values


def _spline(path: Path | str, element: Element, where: str) -> PiecewisePolynomial:
    return functions.simm_spline(numbers(path, element, "x", where), numbers(path, element, "y", where))


def _joined(path: Path | str, element: Element, where: str) -> PiecewisePolynomial:
    return functions.piecewise_linear(numbers(path, element, "x", where), numbers(path, element, "y", where))


def _constant(path: Path | str, element: Element, where: str) -> PiecewisePolynomial:
    return functions.constant(float(numbers(path, element, "value", where, np.zeros(1))[0]))


def _polynomial(path: Path | str, element: Element, where: str) -> PiecewisePolynomial:
    return functions.polynomial(numbers(path, element, "coefficients", where))


def _linear(path: Path | str, element: Element, where: str) -> PiecewisePolynomial:
    return functions.linear(*numbers(path, element, "coefficients", where, np.array([1.0, 0.0])))


def _multiplied(path: Path | str, element: Element, where: str) -> PiecewisePolynomial:
    inner = function_in(path, element, where)
    if inner is None:
        wrong = f"has a MultiplierFunction without a function in {where}"
        raise FileProblem(path, wrong, "Add the function to multiply.")
    return functions.scaled(inner, float(numbers(path, element, "scale", where, np.ones(1))[0]))


READERS: dict[str, Callable[[Path | str, Element, str], PiecewisePolynomial]] = {
    "Constant": _constant,
    "LinearFunction": _linear,
    "PolynomialFunction": _polynomial,
    "SimmSpline": _spline,
    "NaturalCubicSpline": _spline,
    "natCubicSpline": _spline,
    "PiecewiseLinearFunction": _joined,
    "MultiplierFunction": _multiplied,
}
"""Reader of each kind of function; NaturalCubicSpline is the former name of SimmSpline."""


def function_in(
    path: Path | str, element: Element, where: str, wrapper: str = "function"
) -> PiecewisePolynomial | None:
    """Read the function in an element, with or without a wrapper.

    Args:
        path: The file, for error messages.
        element: The element with the function: a transform axis, a constraint, or another function.
        where: Object to which the element belongs, for error messages.
        wrapper: Name of the element around the function in files before version 4.0.

    Returns:
        The function; None if the element has none.

    Raises:
        FileProblem: The function is of an unsupported kind, or its numbers are invalid.
    """
    inside = element.find(wrapper)
    held = list(inside) if inside is not None else [child for child in element if child.get("name") == wrapper]
    held = held or [child for child in element if child.tag in READERS]
    if not held:
        return None
    kind = held[0].tag
    if kind not in READERS:
        wrong = f"has a {kind} in {where}, which is not supported"
        raise FileProblem(path, wrong, f"The supported functions are {', '.join(READERS)}.")
    try:
        return READERS[kind](path, held[0], where)
    except FileProblem:
        raise
    except MareyError as error:
        wrong = f"has an invalid {kind} in {where} ({str(error).rstrip('.')})"
        raise FileProblem(path, wrong, "Correct its numbers.") from error
