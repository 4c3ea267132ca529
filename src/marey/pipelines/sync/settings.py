"""Settings of the synchronisation of cameras."""

from dataclasses import dataclass
from pathlib import Path

from marey.errors import FileProblem


@dataclass(frozen=True, kw_only=True)
class SyncSettings:
    """Settings of the synchronisation of a trial's cameras; None keeps the setting of trial.toml.

    Raises:
        FileProblem: A named folder does not exist.
    """

    out: Path | None = None
    """The file for the clocks; by default `sync.json` in the trial."""
    cameras: tuple[str, ...] | None = None
    """Names of the cameras to use."""
    keypoints: Path | None = None
    """A folder with the joints that a detector found in every image."""

    def __post_init__(self) -> None:
        if self.keypoints is not None and not self.keypoints.exists():
            raise FileProblem(self.keypoints, "does not exist", "Correct keypoints (--keypoints).")

    def changes(self) -> dict[str, object]:
        """Return the settings that replace those of trial.toml, as `read_free_trial` takes them."""
        return {
            "cameras": self.cameras,
            # The path is relative to the current folder, not to the trial.
            "keypoints": None if self.keypoints is None else {"folder": str(self.keypoints.resolve())},
        }
