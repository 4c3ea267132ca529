"""Settings of a surface measurement."""

from dataclasses import dataclass
from pathlib import Path

from marey.errors import FileProblem
from marey.surface.points.settings import SurfaceSettings
from marey.surface.tracks.filters import FilterSettings


@dataclass(frozen=True, kw_only=True)
class SurfaceOptions:
    """Settings of a surface measurement; None keeps the setting of trial.toml or the program's default.

    Raises:
        FileProblem: The file of seeds does not exist.
        SettingProblem: A setting is impossible.
    """

    out: Path | None = None
    """Folder for the results; by default `marey/` in the trial."""
    cameras: tuple[str, ...] | None = None
    """Names of the cameras to use."""
    frames: tuple[int, int | None] | None = None
    """First frame and the one after the last (None for all that follow)."""
    seeds: Path | None = None
    """A table of clicked seeds."""
    sync: str | None = None
    """Whether the clocks in sync.json are used: "file" or "off"."""
    spacing: int = 2
    """Distance of neighbouring points in the image [px]."""
    patch: int = 13
    """Width and height of the smallest patches [px]."""
    refine_rig: bool | None = None
    """Whether the camera poses are corrected by the matches; None corrects them if the matches contradict them."""

    tracks: bool = True
    """Whether points are followed from frame to frame."""
    max_speed: float | None = None
    """Largest speed of a point of the surface [m/s]; None estimates a limit from the data."""
    max_acceleration: float | None = None
    """Largest acceleration of a point [m/s2]; None estimates a limit from the data."""

    def __post_init__(self) -> None:
        if self.seeds is not None and not self.seeds.exists():
            raise FileProblem(self.seeds, "does not exist", "Correct seeds (--seeds).")
        self.settings()
        self.filters()

    def settings(self) -> SurfaceSettings:
        """Return the settings of the matching.

        Raises:
            SettingProblem: A setting is impossible.
        """
        return SurfaceSettings(spacing=self.spacing, patch=self.patch)

    def filters(self) -> FilterSettings:
        """Return the thresholds of false trajectories.

        Raises:
            SettingProblem: A threshold is impossible.
        """
        return FilterSettings(speed=self.max_speed, acceleration=self.max_acceleration)

    def changes(self) -> dict[str, object]:
        """Return the settings that replace those of trial.toml, as `marey.io.trial.trial.read_trial` takes them."""
        return {"cameras": self.cameras, "frames": self.frames, "sync": self.sync}
