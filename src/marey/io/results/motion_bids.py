"""Writing motions as recordings of a Motion-BIDS dataset ([Jeung2024]), which other laboratories and archives read."""

import csv
import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats, freeze_fields
from marey.errors import FileProblem, SettingProblem
from marey.io.atomic import replacing
from marey.io.documents import read_json_table, read_rows, read_text

BIDS_VERSION = "1.9.0"
"""Version of the BIDS specification; motion is part of it since 1.9.0."""
TRACKING_SYSTEM = "marey"
"""Label of the tracking system in the names of the files."""
MISSING = "n/a"
"""Text of missing values."""
WORLD, NO_FRAME = "world", "n/a"
"""Reference frames of channels: the world of the results, or none."""
_LABEL = re.compile(r"[0-9A-Za-z]+")
"""Labels of subjects, sessions and tasks: letters and digits only."""
_HEAD = ("name", "component", "type", "tracked_point", "units", "reference_frame", "description")
"""Columns of `*_channels.tsv`, in the order of the specification."""
_TYPES = ("POS", "ORNT", "JNTANG", "LATENCY", "MISC")
"""Types of channels whose numbers are stated."""
_README = """Motion measured by marey.

Every recording has its channels in `*_channels.tsv`: positions of joints, orientations of segments as unit quaternions,
joint angles, and the standard deviation of each as a channel of type MISC. Missing values are n/a.
"""
"""The README of a new dataset."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MotionChannel:
    """One column of a recording."""

    name: str
    """Name, unique in the recording."""
    component: str
    """`x`, `y`, `z`, `quat_w`, `quat_x`, `quat_y`, `quat_z`, or `n/a`."""
    kind: str
    """Type in BIDS: POS, ORNT, JNTANG, LATENCY or MISC."""
    point: str
    """Joint or segment, or `n/a`."""
    unit: str
    """Unit in BIDS, or `n/a`."""
    values: Floats
    """(F,) values; NaN where missing."""
    description: str
    """What it is, in one sentence."""
    frame: str = NO_FRAME
    """`world`, or `n/a` for quantities without a reference frame."""

    def __post_init__(self) -> None:
        freeze_fields(self, "values")


@dataclass(frozen=True, kw_only=True)
class RecordingLabels:
    """The entities of a recording in the names of its files."""

    subject: str
    """Label of the person."""
    task: str
    """Label of the task."""
    session: str | None = None
    """Label of the session, if there are several."""
    run: int | None = None
    """Number of the repetition, if there are several."""

    def __post_init__(self) -> None:
        for name in ("subject", "session", "task"):
            label = getattr(self, name)
            if label is not None and not _LABEL.fullmatch(label):
                raise SettingProblem(
                    f"The {name} is {label!r} and should have letters and digits only, as in 'walk01'."
                )
        if self.run is not None and self.run < 1:
            raise SettingProblem(f"The run is {self.run} and should be 1 or greater.")

    @property
    def folder(self) -> Path:
        """The folder of the recording in the dataset."""
        session = () if self.session is None else (f"ses-{self.session}",)
        return Path(f"sub-{self.subject}", *session, "motion")

    @property
    def stem(self) -> str:
        """The begin of the names of its files."""
        parts = [f"sub-{self.subject}"]
        parts += [] if self.session is None else [f"ses-{self.session}"]
        parts += [f"task-{self.task}", f"tracksys-{TRACKING_SYSTEM}"]
        parts += [] if self.run is None else [f"run-{self.run:02d}"]
        return "_".join(parts)


def write_motion_bids(
    dataset: Path, labels: RecordingLabels, channels: Sequence[MotionChannel], *, rate: float, version: str
) -> Path:
    """Add a recording to a Motion-BIDS dataset, which is begun if it does not exist.

    Args:
        dataset: The folder of the dataset.
        labels: Subject, task, session and run.
        channels: The columns, each with one value per frame.
        rate: Frames per second [Hz].
        version: Version of the program.

    Returns:
        The file with the values.

    Raises:
        FileProblem: The folder holds something else, or the recording exists.
    """
    _begin(dataset, version)
    _add_person(dataset, labels.subject)
    folder = dataset / labels.folder
    folder.mkdir(parents=True, exist_ok=True)
    values = folder / f"{labels.stem}_motion.tsv"
    if values.exists():
        raise FileProblem(values, "exists", "Give another subject, session, task or run.")
    _write_channels(folder / f"{labels.stem}_channels.tsv", channels)
    _write_json(folder / f"{labels.stem}_channels.json", _reference_frames())
    _write_json(folder / f"{labels.stem}_motion.json", _sidecar(labels, channels, rate, version))
    table = np.stack([channel.values for channel in channels], axis=1)
    with replacing(values) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        for row in table:
            file.write("\t".join(f"{value:.9g}" if np.isfinite(value) else MISSING for value in row) + "\n")
    return values


def _begin(dataset: Path, version: str) -> None:
    """Write what every dataset has, unless the folder is one."""
    description = dataset / "dataset_description.json"
    if description.is_file():
        read_json_table(description, "Give a folder with a BIDS dataset, or a new one.")
        return
    if dataset.exists() and (not dataset.is_dir() or any(dataset.iterdir())):
        raise FileProblem(dataset, "is not a BIDS dataset (no dataset_description.json)", "Give a new folder.")
    dataset.mkdir(parents=True, exist_ok=True)
    _write_text(dataset / "README", _README)
    _write_json(
        description,
        {
            "Name": dataset.resolve().name, "BIDSVersion": BIDS_VERSION, "DatasetType": "raw",
            "GeneratedBy": [{"Name": "marey", "Version": version}],
        },
    )  # fmt: skip


def _add_person(dataset: Path, subject: str) -> None:
    """Add a person to the table of participants."""
    path, name = dataset / "participants.tsv", f"sub-{subject}"
    lines = ["participant_id"]
    if path.is_file():
        text = read_text(path, "Give a folder with a BIDS dataset, or a new one.")
        lines = text.splitlines()
        rows = read_rows(path, lines, "Correct the table.", delimiter="\t")
        if not rows or not rows[0] or rows[0][0] != "participant_id":
            raise FileProblem(path, "does not begin with a column participant_id", "Correct its first line.")
        if any(row and row[0] == name for row in rows[1:]):
            return
        lines.append("\t".join([name, *[MISSING] * (len(rows[0]) - 1)]))
    else:
        lines.append(name)
    _write_text(path, "\n".join(lines) + "\n")


def _write_channels(path: Path, channels: Iterable[MotionChannel]) -> None:
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, delimiter="\t", lineterminator="\n")
        table.writerow(_HEAD)
        for c in channels:
            table.writerow((c.name, c.component, c.kind, c.point, c.unit, c.frame, c.description))


def _reference_frames() -> dict[str, Any]:
    """Describe the world of the results: the third axis points up, the others are those of the calibration."""
    what = "The world of the calibration: right-handed, the third axis points up."
    levels = {
        WORLD: {"Description": what, "SpatialAxes": "__S", "RotationRule": "right-hand"},
        NO_FRAME: {"Description": "The quantity has no reference frame."},
    }
    return {"reference_frame": {"Description": "Reference frame of the channel.", "Levels": levels}}


def _sidecar(
    labels: RecordingLabels, channels: Sequence[MotionChannel], rate: float, version: str
) -> dict[str, Any]:  # fmt: skip
    count = len(channels[0].values)
    kinds = [channel.kind for channel in channels]
    points = {channel.point for channel in channels} - {MISSING}
    counts = {f"{kind}ChannelCount": kinds.count(kind) for kind in _TYPES}
    return {
        "TaskName": labels.task, "SamplingFrequency": rate, "RecordingType": "continuous",
        "RecordingDuration": round(count / rate, 6), "TrackingSystemName": TRACKING_SYSTEM, "Manufacturer": MISSING,
        "SoftwareVersions": f"marey {version}", "TrackedPointsCount": len(points),
        "MotionChannelCount": len(channels), "MissingValues": MISSING, **counts,
    }  # fmt: skip


def _write_json(path: Path, value: dict[str, Any]) -> None:
    _write_text(path, json.dumps(value, indent=2, ensure_ascii=False) + "\n")


def _write_text(path: Path, text: str) -> None:
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
