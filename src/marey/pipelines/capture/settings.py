"""Settings of a capture: those that replace settings of trial.toml, and those of a single run."""

from dataclasses import dataclass
from pathlib import Path

from marey.body.articulation.presets import GENERIC_BODIES
from marey.errors import FileProblem


@dataclass(frozen=True, kw_only=True)
class CaptureSettings:
    """Settings of a capture; None keeps the setting of trial.toml or the program's default.

    Raises:
        FileProblem: A named file does not exist.
    """

    out: Path | None = None
    """Folder for the results; by default `marey/` in the trial."""
    cameras: tuple[str, ...] | None = None
    """Names of the cameras to use."""
    frames: tuple[int, int] | None = None
    """First frame and the one after the last."""
    preset: str | None = None
    """Part of the body that is followed."""
    stature_m: float | None = None
    """The person's height [m]."""
    leg_length_m: float | None = None
    """The person's leg length, from the anterior superior iliac spine to the medial malleolus [m]."""
    asis_distance_m: float | None = None
    """The distance between the person's anterior superior iliac spines [m]."""
    start: Path | None = None
    """A file of clicked or detected joints, or a folder of OpenPose files, to start from."""
    keypoints: Path | None = None
    """A folder with the joints that a detector found in every image."""
    person: int | str | None = None
    """The person to follow: a number, or a click, box or place as text."""
    person_net: Path | None = None
    """A network that segments people, TFLite or ONNX."""
    body: Path | str | None = None
    """A body of an earlier run, or a scan, that replaces the unknown body; or one of `GENERIC_BODIES`."""
    fixed_sizes: bool = False
    """Whether the sizes of the body are kept instead of estimated."""
    surface_tracks: bool = True
    """Whether patches of the surface are tracked through the images, to measure turns of limbs about their axes."""
    overlay: bool = True
    """Whether overlay videos are drawn."""
    camera_uncertainty: bool = True
    """Whether the uncertainty of the cameras, where it is known, enlarges the standard deviations of the results."""
    sync: str | None = None
    """Whether the clocks in sync.json are used: "file" or "off"."""
    check: str | None = None
    """"off": the cameras are not checked against each other before the capture."""

    def __post_init__(self) -> None:
        files = {
            "start": self.start, "keypoints": self.keypoints, "person-net": self.person_net, "body": self.body_file,
        }  # fmt: skip
        for option, path in files.items():
            if path is not None and not path.exists():
                words = f"It may also be {' or '.join(GENERIC_BODIES)}." if option == "body" else ""
                raise FileProblem(path, "does not exist", f"Correct {option} (--{option}). {words}".strip())

    @property
    def body_file(self) -> Path | None:
        """The file of the body; None if there is none."""
        return None if self.body is None or self.body in GENERIC_BODIES else Path(self.body)

    def changes(self) -> dict[str, object]:
        """Return the settings that replace those of trial.toml, as `marey.io.trial.trial.read_trial` takes them."""
        return {
            "cameras": self.cameras,
            "frames": self.frames,
            "preset": self.preset,
            "stature_m": self.stature_m,
            "leg_length_m": self.leg_length_m,
            "asis_distance_m": self.asis_distance_m,
            "sync": self.sync,
            "check": self.check,
            # The path is relative to the current folder, not to the trial.
            "start": None if self.start is None else {"file": str(self.start.resolve())},
            "keypoints": None if self.keypoints is None else {"folder": str(self.keypoints.resolve())},
            "people": None if self.person is None else {"follow": self.person},
            "masks": None if self.person_net is None else {"network": str(self.person_net.resolve())},
        }
