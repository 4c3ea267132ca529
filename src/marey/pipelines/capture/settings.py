"""What was typed for a capture: settings that replace those of trial.toml, and those that concern this run only."""

import re
from dataclasses import dataclass
from pathlib import Path

from marey.body.articulation.presets import GENERIC_BODIES
from marey.errors import FileProblem, SettingProblem


@dataclass(frozen=True, kw_only=True)
class CaptureSettings:
    """What the command line asks for; None leaves what trial.toml says, or what the program finds out itself.

    Raises:
        FileProblem: A file that was named is not there.
    """

    out: Path | None = None
    """Where the results go; `marey/` in the trial when None."""
    cameras: tuple[str, ...] | None = None
    """Names of the cameras to keep."""
    frames: tuple[int, int] | None = None
    """First frame and the first one after the last."""
    preset: str | None = None
    """Which part of the body is followed."""
    stature_m: float | None = None
    """The person's height [m]."""
    start: Path | None = None
    """A file of clicked or detected joints, or a folder of OpenPose files, to start from."""
    body: Path | str | None = None
    """A body found before, or a scan, to be followed instead of an unknown one; or one of `GENERIC_BODIES`."""
    fixed_sizes: bool = False
    """Whether the body keeps its sizes, instead of taking those that the take shows."""
    overlay: bool = True
    """Whether overlay videos are drawn."""

    def __post_init__(self) -> None:
        for option, path in (("--start", self.start), ("--body", self.body_file)):
            if path is not None and not path.exists():
                words = f"It may also be {' or '.join(GENERIC_BODIES)}." if option == "--body" else ""
                raise FileProblem(path, "does not exist", f"Mend {option}. {words}".strip())

    @property
    def body_file(self) -> Path | None:
        """The file of the body, None where there is none."""
        return None if self.body is None or self.body in GENERIC_BODIES else Path(self.body)

    def changes(self) -> dict[str, object]:
        """Give what replaces the settings of trial.toml, as `marey.io.trial.trial.read_trial` takes it."""
        return {
            "cameras": self.cameras,
            "frames": self.frames,
            "preset": self.preset,
            "stature_m": self.stature_m,
            # What was typed is relative to where it was typed, not to the trial.
            "start": None if self.start is None else {"file": str(self.start.resolve())},
        }


def parse_frames(text: str) -> tuple[int, int]:
    """Read `A:B` (frames A to B, without B); an A left away is 0.

    Raises:
        SettingProblem: The text has another form, or A does not lie before B.
    """
    match = re.fullmatch(r"\s*(\d*)\s*:\s*(\d+)\s*", text)
    if match is None or int(match[1] or 0) >= int(match[2]):
        raise SettingProblem(f"--frames is '{text}'; it should be A:B (frames A to B, without B), for example 10:120.")
    return int(match[1] or 0), int(match[2])


def parse_names(text: str, *, option: str = "--cameras", example: str = "cam01,cam02") -> tuple[str, ...]:
    """Read names set apart by commas.

    Args:
        text: As it was typed.
        option: After which it was typed.
        example: What would be right.

    Raises:
        SettingProblem: There is none.
    """
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names:
        raise SettingProblem(f"{option} is '{text}'; it should be names set apart by commas, for example {example}.")
    return names
