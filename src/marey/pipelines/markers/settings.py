"""Settings of a run on skin markers."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from marey.errors import FileProblem, SettingProblem
from marey.io.markers.setup import given_measurements
from marey.markers.data.marker_sets import choose_marker_set
from marey.markers.preprocessing.gaps import FROM_CLUSTER, SPLINE

FILLS: Mapping[str, tuple[int, ...]] = {
    "none": (), "spline": (SPLINE,), "cluster": (FROM_CLUSTER,), "best": (SPLINE, FROM_CLUSTER),
}  # fmt: skip
"""Names of the ways to fill gaps, and the methods among which each chooses; dimensionless."""
SIDES = ("left", "right")
"""Names of the body's sides."""


@dataclass(frozen=True, kw_only=True)
class MarkerSettings:
    """Which files describe the bones beneath the markers, and which part of the trial is used.

    Raises:
        FileProblem: A named file does not exist.
        SettingProblem: A value is impossible, or two settings exclude each other.
    """

    reference: Path | None = None
    """NPZ with the poses of the bones in one frame of the trial, or in several."""
    clusters: Path | None = None
    """TOML with segments, landmarks, joints and noise."""
    static: Path | None = None
    """Trial of the person standing, with landmarks."""
    functional: tuple[Path, ...] = ()
    """Trials in which a hip or shoulder was moved; they give the joint's centre."""
    exercise: Path | None = None
    """Trial from which the motion of the skin over the bones is learned."""
    exercise_reference: Path | None = None
    """NPZ with the poses of the bones in frames of the exercise."""
    model: Path | None = None
    """OpenSim model whose coordinates are estimated instead of the motion of single bones."""
    weights: Path | None = None
    """OpenSim tasks with the weights of markers and coordinates."""
    frames: tuple[int, int] | None = None
    """First frame, and the frame after the last one; None for all."""
    fill: str = "none"
    """How gaps are filled before the bones are estimated; a name of `FILLS`."""
    unit: str | None = None
    """mm, cm or m, if the file states its unit wrongly."""
    side: str | None = None
    """`left` or `right`, if the names of the segments do not contain it."""
    marker_set: str | None = None
    """Key of the marker set of the labels; None to recognise it."""
    person: str | None = None
    """Name of the person before the labels, if the files have the markers of several people."""
    measurements: Mapping[str, float] = field(default_factory=dict)
    """Measurements of the person by the keys of `[person]`, such as `knee_width_mm` [mm], before those of files."""

    def __post_init__(self) -> None:
        self._require_files()
        if self.fill not in FILLS:
            raise SettingProblem(f"fill (--fill) is '{self.fill}'; it should be one of {', '.join(FILLS)}.")
        if self.side is not None and self.side not in SIDES:
            raise SettingProblem(f"side (--side) is '{self.side}'; it should be left or right.")
        if self.weights is not None and self.model is None:
            raise SettingProblem("weights (--weights) requires an OpenSim model: add model (--model).")
        if self.model is not None and (self.reference or self.static or self.clusters):
            raise SettingProblem(
                "An OpenSim model (--model) defines its own segments: leave out the reference (--reference), "
                "clusters (--clusters) and static trial (--static), or the model."
            )
        self._require_fitting_set()
        if self.person is not None and not self.person.strip():
            raise SettingProblem("person (--person) is empty; it should be the name before the labels of a person.")
        given_measurements(self.measurements)
        if self.exercise_reference is not None and self.exercise is None:
            raise SettingProblem(
                "exercise_reference (--exercise-reference) requires the trial that it belongs to: add "
                "exercise (--exercise)."
            )
        if self.functional and self.static is None:
            raise SettingProblem(
                "functional (--functional) gives joint centres in a static trial: add static (--static)."
            )
        if self.reference is not None and self.static is not None:
            raise SettingProblem(
                "reference (--reference) and static (--static) both define the poses of the bones: give one of them."
            )

    def _require_fitting_set(self) -> None:
        if self.marker_set is None:
            return
        choose_marker_set(self.marker_set)
        for option, given in (("model", self.model), ("reference", self.reference)):
            if given:
                raise SettingProblem(
                    f"marker_set (--marker-set) and {_named(option)} exclude each other: leave out one of them."
                )

    def _require_files(self) -> None:
        for option, path in self._files():
            if not path.is_file():
                wrong = "is a folder" if path.is_dir() else "does not exist"
                raise FileProblem(path, wrong, f"Correct {_named(option)}.")
            if option in ("reference", "exercise_reference") and path.suffix.lower() != ".npz":
                remedy = f"Correct {_named(option)}; docs/reference/marker-input.md describes the NPZ."
                raise FileProblem(path, "is not an NPZ", remedy)

    def _files(self) -> list[tuple[str, Path]]:
        named = {
            "reference": self.reference, "clusters": self.clusters, "static": self.static, "exercise": self.exercise,
            "exercise_reference": self.exercise_reference, "model": self.model, "weights": self.weights,
        }  # fmt: skip
        files = [(option, path) for option, path in named.items() if path is not None]
        return files + [("functional", path) for path in self.functional]

    @property
    def files(self) -> list[Path]:
        """All files that the settings name, the trial itself not among them."""
        return [path for _, path in self._files()]


def _named(setting: str) -> str:
    """Return the name of a setting with that of its option."""
    return f"{setting} (--{setting.replace('_', '-')})"
