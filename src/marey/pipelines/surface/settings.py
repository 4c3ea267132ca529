"""What was typed for a surface."""

from dataclasses import dataclass
from pathlib import Path

from marey.errors import FileProblem
from marey.surface.points.settings import SurfaceSettings
from marey.surface.tracks.filters import FilterSettings


@dataclass(frozen=True, kw_only=True)
class SurfaceOptions:
    """What the command line asks for; None leaves what trial.toml says, or what the program finds out itself.

    Raises:
        FileProblem: The file of seeds does not exist.
        SettingProblem: A setting is impossible.
    """

    out: Path | None = None
    """Where the results go; `marey/` in the trial when None."""
    cameras: tuple[str, ...] | None = None
    """Names of the cameras to keep."""
    frames: tuple[int, int] | None = None
    """First frame and the first one after the last."""
    seeds: Path | None = None
    """A table of clicked seeds."""
    spacing: int = 2
    """Distance from point to point [px]."""
    patch: int = 13
    """Width and height of the smallest patches [px]."""
    refine_rig: bool | None = None
    """Whether the cameras are corrected by the matches; None where they plainly need it."""

    tracks: bool = True
    """Whether points are followed from frame to frame, where there are several."""
    max_speed: float | None = None
    """No point of the surface moves faster [m/s]; None finds a limit from the data."""
    max_acceleration: float | None = None
    """Likewise [m/s2]."""

    def __post_init__(self) -> None:
        if self.seeds is not None and not self.seeds.exists():
            raise FileProblem(self.seeds, "does not exist", "Correct --seeds.")
        self.settings()
        self.filters()

    def settings(self) -> SurfaceSettings:
        """Return the settings of the matching.

        Raises:
            SettingProblem: One is impossible.
        """
        return SurfaceSettings(spacing=self.spacing, patch=self.patch)

    def filters(self) -> FilterSettings:
        """Give the thresholds of false tracks.

        Raises:
            SettingProblem: One is impossible.
        """
        return FilterSettings(speed=self.max_speed, acceleration=self.max_acceleration)

    def changes(self) -> dict[str, object]:
        """Give what replaces the settings of trial.toml, as `marey.io.trial.trial.read_trial` takes it."""
        return {"cameras": self.cameras, "frames": self.frames}
