"""What a user asks for: the settings of a capture, from trial.toml and the command line, checked at the door."""

import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

from marey.errors import SettingProblem

PRESETS = ("full", "upper", "left_arm", "right_arm", "left_leg", "right_leg")
UPS = ("z", "-z", "y", "-y", "x", "-x")
STATURE_M = (0.5, 2.6)
"""People of whom measurements were ever published stand between these."""
MASS_KG = (5.0, 400.0)


@dataclass(frozen=True, kw_only=True)
class CaptureSettings:
    """What a capture is asked to do; None stands where the program finds out itself.

    Raises:
        SettingProblem: A value cannot be used; the message says which, and what would do.
    """

    out: Path | None = None
    """Where the results go; `marey/` in the trial when None."""
    preset: str = "full"
    """One of `PRESETS`: which part of the body is followed."""
    cameras: tuple[str, ...] | None = None
    """Names of the cameras to keep; all when None."""
    frames: tuple[int, int] | None = None
    """First frame and the first one after the last; all when None."""
    stature_m: float | None = None
    """The person's height, where it is known [m]."""
    mass_kg: float | None = None
    """The person's mass, where it is known [kg]."""
    rate: float | None = None
    """Frames a second, where the videos' containers are wrong [Hz]."""
    person: str | None = None
    """Who is captured, for the titles."""
    start: Path | None = None
    """A file of clicked or detected joints, or a folder of OpenPose files, to start from."""
    body: Path | None = None
    """A body found before, or a scan, to be followed instead of an unknown one."""
    background: Path | None = None
    """The folder with pictures or clips of the empty room, where it is not `background/` in the trial."""
    up: str | None = None
    """The world's axis that points up; where it is not given, a lying person is taken for an error."""
    overlay: bool = True
    """Whether overlay videos are drawn."""

    def __post_init__(self) -> None:
        for name in ("cameras", "frames"):
            if isinstance(getattr(self, name), list):
                object.__setattr__(self, name, tuple(getattr(self, name)))
        faults = [fault for fault in (
            _choice("preset", self.preset, PRESETS),
            None if self.up is None else _choice("up", self.up, UPS),
            _between("stature_m", self.stature_m, STATURE_M, "metres, for example 1.80"),
            _between("mass_kg", self.mass_kg, MASS_KG, "kilograms, for example 75"),
            _between("rate", self.rate, (1e-3, 1e5), "frames a second, for example 60"),
            _frames_fault(self.frames),
            "cameras names none; leave it away to keep all" if self.cameras == () else None,
        ) if fault]  # fmt: skip
        if faults:
            raise SettingProblem("; ".join(faults) + ".")

    def with_options(self, **options: object) -> "CaptureSettings":
        """Let options of the command line win over these settings; None leaves a setting as it is."""
        return replace(self, **{name: value for name, value in options.items() if value is not None})  # type: ignore[arg-type]

    def as_text(self) -> dict[str, object]:
        """Give the settings in a form that JSON can hold."""
        return {name: str(value) if isinstance(value, Path) else value for name, value in asdict(self).items()}


def from_trial(given: Mapping[str, object]) -> CaptureSettings:
    """Take the settings that a trial's own file gives.

    Args:
        given: Values by the names of `CaptureSettings`; None and other names, which belong to the reader, are left out.

    Raises:
        SettingProblem: A value cannot be used.
    """
    known = {field.name for field in fields(CaptureSettings)}
    return CaptureSettings(**{n: v for n, v in given.items() if n in known and v is not None})  # type: ignore[arg-type]


def parse_frames(text: str) -> tuple[int, int]:
    """Read `A:B` (frames A to B, without B); an A left away is 0.

    Raises:
        SettingProblem: The text has another form.
    """
    match = re.fullmatch(r"\s*(\d*)\s*:\s*(\d+)\s*", text)
    if match is None:
        raise SettingProblem(f"--frames is '{text}'; it should be A:B (frames A to B, without B), for example 10:120.")
    return int(match[1] or 0), int(match[2])


def parse_names(text: str) -> tuple[str, ...]:
    """Read names set apart by commas.

    Raises:
        SettingProblem: There is none.
    """
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names:
        raise SettingProblem(f"--cameras is '{text}'; it should be names set apart by commas, for example cam01,cam02.")
    return names


def _choice(name: str, value: str, known: tuple[str, ...]) -> str | None:
    return None if value in known else f"{name} is '{value}'; it should be one of {', '.join(known)}"


def _between(name: str, value: float | None, limits: tuple[float, float], unit: str) -> str | None:
    if value is None or (math.isfinite(value) and limits[0] <= value <= limits[1]):
        return None
    return f"{name} is {value:g}; it should lie between {limits[0]:g} and {limits[1]:g} {unit}"


def _frames_fault(frames: tuple[int, int] | None) -> str | None:
    if frames is None or 0 <= frames[0] < frames[1]:
        return None
    return f"frames are {frames[0]} to {frames[1]}; the first must be 0 or later and lie before the end"
