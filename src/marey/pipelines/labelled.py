"""Labelled results: values over time with their name, unit, standard deviation and flags."""

import difflib
import html
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any, overload

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.errors import MareyError
from marey.extras import import_optional
from marey.view.pages.problems import readable
from marey.wording import count_of

MEASURED = ""
"""The flag of a value that was measured and is to be used as it is."""
_NEAR_MATCHES = 5
"""Similar names that an error lists at most."""
_LEAST_LIKENESS = 0.3
"""Similarity of two names, from 0 to 1, below which an error does not suggest one in place of the other."""


class UnknownName(MareyError, KeyError):
    """A name that does not exist in a result; the message lists the most similar names."""

    __str__ = Exception.__str__


def find_name(name: str, names: Sequence[str], *, kind: str) -> int:
    """Find a name in a list, whether it is written with spaces, hyphens or underscores, in upper or lower case.

    Args:
        name: The name to be found.
        names: All names.
        kind: The kind of quantity that they name, for the error, for example "angle".

    Returns:
        The index of the name.

    Raises:
        UnknownName: It is not in the list; the message names the most similar ones.
    """
    if name in names:
        return list(names).index(name)
    wanted, plain = _plain(name), [_plain(other) for other in names]
    if wanted in plain:
        return plain.index(wanted)
    near = difflib.get_close_matches(wanted, plain, n=_NEAR_MATCHES, cutoff=_LEAST_LIKENESS)
    listed = [readable(names[plain.index(other)]) for other in near]
    known = f"Did you mean: {', '.join(listed)}?" if listed else f"There are {len(names)} {kind}s."
    raise UnknownName(f"There is no {kind} {name!r}. {known}")


def _plain(name: str) -> str:
    return " ".join(name.replace("_", " ").replace("-", " ").lower().split())


@dataclass(frozen=True, eq=False, kw_only=True)
class Curve:
    """One quantity over time: its values with their standard deviations, and a flag for every value.

    A curve is used like a NumPy array: `np.asarray(curve)` and NumPy's functions take its values, `curve[10:20]` is the
    curve of some frames, `curve[3]` the value of one frame.

    Example:
        >>> import numpy as np
        >>> from marey.pipelines.labelled import Curve
        >>> curve = Curve(name="left_knee_flexion", time=[0.0, 0.5, 1.0], values=[10.0, 40.0, 20.0], sd=[2.0, 2.0, 4.0],
        ...               unit="deg")
        >>> curve
        left knee flexion [deg]: 3 frames, 0 to 1 s; 10 to 40, median standard deviation 2
        >>> float(np.max(curve))
        40.0
        >>> low, high = curve.interval(0.95)
        >>> low.round(1).tolist()
        [6.1, 36.1, 12.2]
    """

    name: str
    """As in the files, for example `left_knee_flexion`."""
    time: Floats
    """(F,) [s]."""
    values: Floats
    """(F,), or (F, n) for a quantity of several components, in `unit`; NaN where there is no value."""
    sd: Floats | None = None
    """Standard deviations, of the shape of the values and in the same unit; None if they are not known."""
    unit: str = ""
    """Unit of values and standard deviations, for example `deg` or `m`."""
    flags: tuple[str, ...] = ()
    """(F,) flag of each value, for example `filled`; an empty text for a plain measurement."""
    components: tuple[str, ...] = ()
    """Names of the n components, for example x, y, z; empty for a scalar quantity."""

    def __post_init__(self) -> None:
        freeze_fields(self, "time", "values", "sd")
        frames = len(self.time)
        shape = (frames, len(self.components)) if self.components else (frames,)
        flags = tuple(self.flags) if len(self.flags) else (MEASURED,) * frames
        object.__setattr__(self, "flags", flags)
        for what, array in (("values", self.values), ("standard deviations", self.sd)):
            if array is not None and array.shape != shape:
                raise MareyError(f"The {what} of {self.name} have the shape {array.shape}; expected {shape}.")
        if len(flags) != frames:
            raise MareyError(f"{self.name} has {len(flags)} flags for {frames} frames.")

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.time)

    def __iter__(self) -> Iterator[Any]:
        return iter(self.values)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """Return the values, for NumPy."""
        return np.array(self.values, dtype=dtype) if copy else np.asarray(self.values, dtype=dtype)

    @overload
    def __getitem__(self, chosen: int) -> Any: ...
    @overload
    def __getitem__(self, chosen: slice | Sequence[int] | np.ndarray) -> "Curve": ...
    def __getitem__(self, chosen: Any) -> Any:
        """Return the value of one frame, or the curve of some frames (a slice, indices, or a mask)."""
        if isinstance(chosen, int | np.integer):
            return self.values[chosen]
        index = np.arange(len(self))[chosen]
        return replace(
            self, time=self.time[index], values=self.values[index], sd=None if self.sd is None else self.sd[index],
            flags=tuple(self.flags[i] for i in index),
        )  # fmt: skip

    def component(self, name: str) -> "Curve":
        """Return one component as a separate curve.

        Args:
            name: One of `components`.

        Raises:
            UnknownName: There is no such component.
        """
        i = find_name(name, self.components, kind="component")
        return replace(
            self, name=f"{self.name}_{self.components[i]}", values=self.values[:, i],
            sd=None if self.sd is None else self.sd[:, i], components=(),
        )  # fmt: skip

    def interval(self, level: float = 0.95) -> tuple[Floats, Floats]:
        """Return the interval that contains the true value with a given probability, for normally distributed errors.

        Args:
            level: The probability, between 0 and 1.

        Returns:
            The lower and the upper limit, each of the shape of the values and in their unit.

        Raises:
            MareyError: The standard deviations are not known, or the level is no probability.
        """
        if self.sd is None:
            raise MareyError(f"The standard deviations of {readable(self.name)} are not known.")
        if not 0.0 < level < 1.0:
            raise MareyError(f"The level of an interval is {level:g}; it must lie between 0 and 1.")
        reach = NormalDist().inv_cdf(0.5 + 0.5 * level) * self.sd
        return self.values - reach, self.values + reach

    @property
    def measured(self) -> np.ndarray:
        """(F,) true where the value is a plain measurement: present, and without a flag."""
        present = np.isfinite(self.values).reshape(len(self), -1).all(axis=1)
        return present & np.array([flag == MEASURED for flag in self.flags], bool)

    def __repr__(self) -> str:
        unit = f" [{self.unit}]" if self.unit else ""
        known = self.values[np.isfinite(self.values)]
        span = f", {self.time[0]:.3g} to {self.time[-1]:.3g} s" if len(self) else ""
        head = f"{readable(self.name)}{unit}: {count_of(len(self), 'frame')}{span}"
        if not known.size:
            return f"{head}; no values"
        text = f"{head}; {known.min():.4g} to {known.max():.4g}"
        if self.sd is not None and np.isfinite(self.sd).any():
            text += f", median standard deviation {np.nanmedian(self.sd):.3g}"
        flagged = {flag: self.flags.count(flag) for flag in dict.fromkeys(self.flags) if flag != MEASURED}
        return text + "".join(f"; {number} {flag}" for flag, number in flagged.items())

    def to_xarray(self) -> Any:
        """Return the curve as an `xarray.DataArray` with the dimension `time`; its unit is an attribute.

        Raises:
            MissingPackage: xarray is not installed.
        """
        xarray = import_optional("xarray", extra="xarray", purpose="Labelled arrays")
        coordinates: dict[str, Any] = {"time": ("time", self.time, {"units": "s"}), "flag": ("time", list(self.flags))}
        if self.components:
            coordinates["component"] = list(self.components)
        dimensions = ("time", "component") if self.components else ("time",)
        return xarray.DataArray(
            self.values, dims=dimensions, coords=coordinates, name=self.name, attrs={"units": self.unit}
        )

    def plot(self, *, level: float = 0.95, axes: Any = None) -> Any:
        """Draw the curve over time, with the interval of its values as a band.

        Args:
            level: Probability of the interval.
            axes: Matplotlib's axes to draw on; new ones by default.

        Returns:
            The axes.

        Raises:
            MissingPackage: Matplotlib is not installed.
        """
        return plot_curves([self], level=level, axes=axes)


def plot_curves(curves: Sequence[Curve], *, level: float = 0.95, axes: Any = None) -> Any:
    """Draw several curves of the same unit over time, each with the interval of its values as a band.

    Args:
        curves: The curves.
        level: Probability of the interval.
        axes: Matplotlib's axes to draw on; new ones by default.

    Returns:
        The axes.

    Raises:
        MissingPackage: Matplotlib is not installed.
    """
    from marey.view.pictures.plots import Line, draw_lines

    lines = []
    for curve in curves:
        for part in [curve.component(name) for name in curve.components] or [curve]:
            low, high = part.interval(level) if part.sd is not None else (None, None)
            lines.append(Line(label=readable(part.name), time=part.time, values=part.values, low=low, high=high))
    units = dict.fromkeys(curve.unit for curve in curves)
    return draw_lines(lines, unit=", ".join(unit for unit in units if unit), axes=axes)


class Curves(Mapping[str, Curve]):
    """Several quantities over the same time, by name.

    A name is found whether it is written with spaces or underscores; the error for an unknown name lists the most
    similar ones.

    Args:
        kind: What the curves are, in the singular, for example "angle".
        names: Names of the curves, as in the files.
        make: Returns the curve of an index.
    """

    def __init__(self, kind: str, names: Sequence[str], make: Callable[[int], Curve]):
        self._kind, self._names, self._make = kind, tuple(names), make

    @property
    def names(self) -> tuple[str, ...]:
        """The names, as in the files."""
        return self._names

    def __getitem__(self, name: str) -> Curve:
        return self._make(find_name(name, self._names, kind=self._kind))

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        """Return the number of curves."""
        return len(self._names)

    def matching(self, pattern: str | Sequence[str]) -> list[Curve]:
        """Return the curves whose names contain a text, for example "knee", or the curves of several names.

        Args:
            pattern: The text, with spaces or underscores; or a list of whole names.

        Raises:
            UnknownName: No name contains the text, or there is no curve of one of the names.
        """
        if not isinstance(pattern, str):
            return [self[name] for name in pattern]
        wanted = _plain(pattern)
        found = [i for i, name in enumerate(self._names) if wanted in _plain(name)]
        if not found:
            find_name(pattern, self._names, kind=self._kind)
        return [self._make(i) for i in found]

    def __repr__(self) -> str:
        return f"{count_of(len(self), self._kind)}: {', '.join(map(readable, self._names))}"


@dataclass(frozen=True)
class Summary:
    """The readable description of a result: a title, and one line per figure."""

    title: str
    lines: Mapping[str, str]
    """Text by label."""

    def __str__(self) -> str:
        width = max(map(len, self.lines), default=0)
        return "\n".join([self.title, *(f"  {label:<{width}}  {text}" for label, text in self.lines.items())])

    def html(self) -> str:
        """Return the description as an HTML table, for notebooks."""
        rows = "".join(
            f"<tr><th style='text-align:left'>{html.escape(label)}</th>"
            f"<td style='text-align:left'>{html.escape(text)}</td></tr>"
            for label, text in self.lines.items()
        )
        return f"<b>{html.escape(self.title)}</b><table>{rows}</table>"


class Described(ABC):
    """A result that is shown as its summary, in a terminal and in a notebook."""

    @abstractmethod
    def summary(self) -> Summary:
        """Return the readable description."""

    def __repr__(self) -> str:
        return str(self.summary())

    def _repr_html_(self) -> str:
        return self.summary().html()
