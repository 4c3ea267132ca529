"""Order of a few numbers inside kernels, which do not compile Numba's general sorting for it."""

from marey.arrays import Floats
from marey.compiled.kernels import kernel


@kernel
def insert(ascending: Floats, count: int, value: float) -> None:
    """Insert a value into the first `count` ones, which are in ascending order."""
    place = count
    while place > 0 and ascending[place - 1] > value:
        ascending[place] = ascending[place - 1]
        place -= 1
    ascending[place] = value


@kernel
def middle(ascending: Floats, count: int) -> float:
    """Return the median of the first `count` numbers, which are in ascending order."""
    return float(0.5 * (ascending[(count - 1) // 2] + ascending[count // 2]))
