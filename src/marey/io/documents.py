"""Text, JSON, TOML and XML files: read completely and within limits, or reported in one line.

All readers of such files use these functions, so that a file of impossible size, of endless depth or with numbers of
thousands of digits is reported in the same way everywhere.
"""

import csv
import json
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from pydantic import BeforeValidator

from marey.arrays import Floats
from marey.errors import FileProblem

LARGEST_DOCUMENT = 64 * 2**20
"""Size from which a text document is not read [bytes]. Chosen by hand: calibrations and settings have some kilobytes,
outlines of a knee some megabytes."""


def _no_other_kind(value: object) -> object:
    """Refuse truth values and texts, which pydantic would convert to numbers."""
    if isinstance(value, bool | str):
        raise ValueError("it should be a number")
    return value


Number = Annotated[float, BeforeValidator(_no_other_kind)]
WholeNumber = Annotated[int, BeforeValidator(_no_other_kind)]


def read_bytes(path: Path | str, remedy: str) -> bytes:
    """Read a small file.

    Args:
        path: The file.
        remedy: Description of a correct file, as a sentence.

    Raises:
        FileProblem: The file cannot be read, or is too large for a document.
    """
    path = Path(path)
    try:
        if path.stat().st_size > LARGEST_DOCUMENT:
            wrong = f"has more than {LARGEST_DOCUMENT // 2**20} MB, which is too large for such a file"
            raise FileProblem(path, wrong, remedy)
        return path.read_bytes()
    except FileNotFoundError as error:
        raise FileProblem(path, "does not exist", remedy) from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise FileProblem(path, f"cannot be read ({reason})", "Check its name and its permissions.") from error


def read_text(path: Path | str, remedy: str) -> str:
    """Read a small text file.

    Args:
        path: The file.
        remedy: Description of a correct file, as a sentence.

    Raises:
        FileProblem: The file cannot be read, is too large, or is not text in UTF-8.
    """
    try:
        return read_bytes(path, remedy).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileProblem(path, f"is not text in UTF-8 (byte {error.start})", remedy) from error


def read_json(path: Path | str, remedy: str) -> Any:
    """Read a JSON file.

    Args:
        path: The file.
        remedy: Description of a correct file, as a sentence.

    Returns:
        Its content.

    Raises:
        FileProblem: The file cannot be read, or is not JSON.
    """
    try:
        return json.loads(read_text(path, remedy))
    except (ValueError, RecursionError) as error:
        raise FileProblem(path, f"is not JSON: {error}", remedy) from error


def read_json_table(path: Path | str, remedy: str) -> dict[str, Any]:
    """Read a JSON file whose content is a table of keys and values; the arguments are those of `read_json`."""
    content = read_json(path, remedy)
    if not isinstance(content, dict):
        raise FileProblem(path, "is not a table of keys and values", remedy)
    return content


def read_tables(path: Path | str, remedy: str = "Correct that line.") -> dict[str, Any]:
    """Read a TOML file.

    Args:
        path: The file.
        remedy: Description of a correct file, as a sentence.

    Returns:
        Its tables.

    Raises:
        FileProblem: The file cannot be read, or is not TOML.
    """
    return tables_of_text(path, read_text(path, "It should be a TOML file."), remedy)


def tables_of_text(path: Path | str, text: str, remedy: str = "Correct that line.") -> dict[str, Any]:
    """Return the tables of a text in TOML.

    Args:
        path: The file that the text was read from.
        text: The text.
        remedy: Description of a correct file, as a sentence.

    Raises:
        FileProblem: The text is not TOML.
    """
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise FileProblem(path, f"is not TOML: {error}", remedy) from error


def read_xml(path: Path | str, remedy: str) -> Element:
    """Read an XML file without entities of its own, which could expand without bound.

    Args:
        path: The file.
        remedy: Description of a correct file, as a sentence.

    Returns:
        The root.

    Raises:
        FileProblem: The file cannot be read, or is not such an XML.
    """
    content = read_bytes(path, remedy)
    if b"<!ENTITY" in content or b"<!DOCTYPE" in content:
        raise FileProblem(path, "defines entities, which such a file does not need", remedy)
    try:
        return ElementTree.fromstring(content)
    except (ElementTree.ParseError, LookupError, ValueError, RecursionError) as error:
        raise FileProblem(path, f"is not XML: {error}", remedy) from error


def read_rows(path: Path | str, lines: Iterable[str], remedy: str, *, delimiter: str = ",") -> list[list[str]]:
    """Split the lines of a table of text into cells.

    Args:
        path: The file, for errors.
        lines: Its lines.
        remedy: What the user can do, for errors.
        delimiter: What separates cells.

    Returns:
        The cells of each line.

    Raises:
        FileProblem: A cell is longer than any number or name, or a quotation mark is not closed in its line.
    """
    lines = list(lines)
    try:
        rows = list(csv.reader(lines, delimiter=delimiter, strict=True))
    except csv.Error as error:
        raise FileProblem(path, f"is not a table of text ({error})", remedy) from error
    if len(rows) != len(lines):
        raise FileProblem(path, "has a quotation mark that is not closed in its line", remedy)
    return rows


def require_stated_count(path: Path | str, key: str, stated: str | None, count: int) -> None:
    """Check that a table has as many rows, or columns, as its header states: fewer were lost on the way.

    Args:
        path: The file, for errors.
        key: Name of the number in the header.
        stated: The number; None if there is none.
        count: How many the table has.

    Raises:
        FileProblem: The table has fewer.
    """
    text = (stated or "").strip()
    if text and not text.isdecimal():
        raise FileProblem(path, f"has {key} {text[:20]!r}", "It should be a whole number.")
    if text and (len(text) > 18 or int(text) > count):
        raise FileProblem(path, f"states {key} {text[:20]}, but has {count}", "Copy or export it again, or correct it.")


def numbers(value: object, shape: tuple[int, ...] | None) -> Floats | None:
    """Convert lists of a document to an array, or return None if they are not numbers of the given shape.

    Args:
        value: The value in the document.
        shape: The required shape, in which -1 stands for any length; None for a vector of any length.

    Returns:
        The array, or None.
    """
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError, RecursionError):
        return None
    wanted = (-1,) if shape is None else shape
    fits = array.ndim == len(wanted) and all(size in (-1, own) for size, own in zip(wanted, array.shape, strict=True))
    return array if fits else None


def finite(value: object, shape: tuple[int, ...] | None) -> Floats | None:
    """Convert lists to an array as `numbers` does, but also return None if a number is not finite."""
    array = numbers(value, shape)
    return array if array is not None and np.isfinite(array).all() else None


def finite_number(value: object) -> float | None:
    """Return a finite number of a document, or None if it is none; texts and Boolean values are not numbers."""
    number = None if isinstance(value, bool | str) else finite(value, ())
    return None if number is None else float(number)


def whole_number(value: object, *, least: int, greatest: int) -> int | None:
    """Return a whole number of a document, or None if it is none, or lies outside the given limits."""
    if isinstance(value, bool) or not isinstance(value, int | float | str) or len(str(value)) > 20:
        return None
    try:
        number = int(value)
    except (ValueError, OverflowError):
        return None
    same = isinstance(value, str) or number == value
    return number if same and least <= number <= greatest else None
