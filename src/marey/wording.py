"""Formatting of names and numbers in messages and reports."""

from collections.abc import Iterable


def count_of(number: int, noun: str) -> str:
    """Write a number with its noun, in the plural unless the number is 1.

    Args:
        number: The number.
        noun: The noun in the singular; its plural ends in s.

    Returns:
        The text.

    Example:
        >>> from marey.wording import count_of
        >>> count_of(1, "trial"), count_of(2, "trial")
        ('1 trial', '2 trials')
    """
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def listed(names: Iterable[str], *, most: int | None = None, none: str = "none") -> str:
    """Join names for a message: `a, b, c`, or `a, b and 3 more`.

    Args:
        names: The names in the order in which they appear.
        most: Largest number of names that are written out; all of them by default.
        none: Text in place of no names.

    Returns:
        The text.

    Example:
        >>> from marey.wording import listed
        >>> listed(["LASI", "RASI", "LPSI", "RPSI"], most=2)
        'LASI, RASI and 2 more'
    """
    known = tuple(names)
    if not known:
        return none
    left = 0 if most is None else len(known) - most
    return ", ".join(known[:most]) + (f" and {left} more" if left > 0 else "")
