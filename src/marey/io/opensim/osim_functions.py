"""Functions of a coordinate and numbers in the XML of OpenSim's models."""

from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from marey.arrays import Floats
from marey.body.articulation import coordinate_functions as functions
from marey.body.articulation.coordinate_functions import PiecewisePolynomial
from marey.errors import FileProblem, MareyError


def read_xml(path: Path | str, kind: str) -> Element:
    """Read an XML file.

    Args:
        path: The file.
        kind: What it should be, for the message.

    Raises:
        FileProblem: It cannot be read, or is no XML.
    """
    try:
        return ElementTree.parse(path).getroot()
    except OSError as error:
        raise FileProblem(path, f"cannot be read ({error.strerror})", f"Give {kind}.") from error
    except (ElementTree.ParseError, UnicodeDecodeError) as error:
        raise FileProblem(path, f"is no XML ({error})", f"Give {kind}.") from error


def text(element: Element | None, tag: str, default: str = "") -> str:
    """Give the text of a child element without the blanks around it, or a default where it is missing or empty."""
    return ((element.findtext(tag) if element is not None else None) or "").strip() or default


def truth(element: Element, tag: str, default: bool = False) -> bool:
    """Read a child element that says true or false."""
    return text(element, tag, str(default)).lower() in ("true", "1")


def numbers(path: Path | str, element: Element, tag: str, where: str, default: Floats | None = None) -> Floats:
    """Read the numbers of a child element.

    Args:
        path: The file, for the message.
        element: Where it stands.
        tag: Its name.
        where: What the element belongs to, for the message.
        default: When it is missing; without one it must be there, and has as many numbers as the default.

    Raises:
        FileProblem: It is missing, or holds something else.
    """
    given = text(element, tag)
    if not given and default is not None:
        return np.asarray(default, float)
    try:
        values = np.array([float(word) for word in given.replace(",", " ").split()])
    except ValueError as error:
        raise FileProblem(path, f"has no numbers in <{tag}> of {where} but {given[:40]!r}", "Mend them.") from error
    count = None if default is None else np.size(default)
    if not len(values) or (count is not None and len(values) != count) or not np.isfinite(values).all():
        raise FileProblem(
            path, f"has {given[:40]!r} in <{tag}> of {where}", f"Write {count or 'finite'} numbers there."
        )
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
        raise FileProblem(path, f"has a MultiplierFunction without a function in {where}", "Write one into it.")
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
"""How each kind of function is read; NaturalCubicSpline is the old name of SimmSpline."""


def function_in(
    path: Path | str, element: Element, where: str, wrapper: str = "function"
) -> PiecewisePolynomial | None:
    """Read the function that an element holds, bare or wrapped; None where it holds none.

    Args:
        path: The file, for messages.
        element: What holds the function: a transform axis, a constraint, another function.
        where: What it belongs to, for messages.
        wrapper: The element around the function in files before 4.0.

    Raises:
        FileProblem: The function is of a kind that is not read, or its numbers make no function.
    """
    inside = element.find(wrapper)
    held = list(inside) if inside is not None else [child for child in element if child.get("name") == wrapper]
    held = held or [child for child in element if child.tag in READERS]
    if not held:
        return None
    kind = held[0].tag
    if kind not in READERS:
        raise FileProblem(path, f"has a {kind} in {where}, which is not read", f"Read are {', '.join(READERS)}.")
    try:
        return READERS[kind](path, held[0], where)
    except FileProblem:
        raise
    except MareyError as error:
        raise FileProblem(path, f"has a {kind} in {where} that is none ({error})", "Mend it.") from error
