"""What was typed for a run on markers."""

from dataclasses import dataclass
from pathlib import Path

from marey.errors import FileProblem, SettingProblem

FILLS = ("none", "spline", "cluster", "best")
SIDES = ("left", "right")


@dataclass(frozen=True, kw_only=True)
class MarkersOptions:
    """What the command line asks for; None leaves it to the program.

    Raises:
        FileProblem: A file that was named is not there.
        SettingProblem: A value is impossible.
    """

    out: Path | None = None
    """Where the results go; `FILE_marey` beside the trial when None."""
    reference: Path | None = None
    """An NPZ that says where the bones were in a frame, or in several."""
    setup: Path | None = None
    """A TOML of segments, landmarks, joints and noise."""
    static: Path | None = None
    """A trial of a person who stands, with landmarks."""
    functional: tuple[Path, ...] = ()
    """Trials in which a joint was moved about."""
    exercise: Path | None = None
    """A trial from which the markers' motion over the bones is learned."""
    exercise_reference: Path | None = None
    """An NPZ that says where the bones were in frames of the exercise."""
    methods: tuple[str, ...] | None = None
    """Names of methods, or `all`; the default one when None."""
    model: Path | None = None
    """An OpenSim model whose coordinates are estimated instead."""
    weights: Path | None = None
    """Its tasks and their weights."""
    frames: tuple[int, int] | None = None
    """First frame and the first one after the last."""
    fill: str = "none"
    """How gaps are filled before the methods work."""
    unit: str | None = None
    """mm, cm or m, where the file says it wrong."""
    side: str | None = None
    """`left` or `right`, where the segments' names do not tell."""

    def __post_init__(self) -> None:
        named = {
            "--reference": self.reference, "--clusters": self.setup, "--static": self.static,
            "--exercise": self.exercise, "--exercise-reference": self.exercise_reference, "--model": self.model,
            "--weights": self.weights,
        }  # fmt: skip
        files = [*named.items(), *(("--functional", path) for path in self.functional)]
        for option, path in files:
            if path is not None and not path.is_file():
                raise FileProblem(path, "is a folder" if path.is_dir() else "does not exist", f"Mend {option}.")
        for option, path in (("--reference", self.reference), ("--exercise-reference", self.exercise_reference)):
            if path is not None and path.suffix.lower() != ".npz":
                raise FileProblem(path, "is no NPZ", f"Mend {option}; docs/markers.md says what it holds.")
        if self.fill not in FILLS:
            raise SettingProblem(f"--fill is '{self.fill}'; it should be one of {', '.join(FILLS)}.")
        if self.side is not None and self.side not in SIDES:
            raise SettingProblem(f"--side is '{self.side}'; it should be left or right.")
        if self.weights is not None and self.model is None:
            raise SettingProblem("--weights belongs to --model: name the OpenSim model, too.")
        if self.model is not None and (self.methods or self.reference or self.static or self.setup):
            raise SettingProblem("--model brings its own segments and method: give it without the options of clusters.")
        if self.exercise_reference is not None and self.exercise is None:
            raise SettingProblem("--exercise-reference belongs to --exercise: name the trial, too.")
        if self.functional and self.static is None:
            raise SettingProblem("--functional tells where joints are in a static trial: give --static, too.")
        if self.reference is not None and self.static is not None:
            raise SettingProblem("--reference and --static both say how the bones lie: give one of them.")

    @property
    def files(self) -> list[Path]:
        """The files that were named, besides the trial."""
        one = (
            self.reference, self.setup, self.static, self.exercise, self.exercise_reference, self.model, self.weights,
        )  # fmt: skip
        return [path for path in one if path is not None] + list(self.functional)
