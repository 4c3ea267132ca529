"""The knee in the scanner that is moved by an activity: structures, markers and side."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from marey.errors import FileProblem
from marey.io.mr.meshes import read_mesh
from marey.io.mr.scanner_markers import read_landmarks, read_scanner_markers
from marey.knee.markers.anatomical_frames import Landmarks
from marey.knee.markers.marker_bones import bone_of_segment
from marey.knee.markers.marker_naming import ScannerMarkers
from marey.knee.markers.reference_posture import Activity
from marey.knee.space.sides import is_left
from marey.knee.space.structures import BONE_OF_CARTILAGE, BONES, LABELS
from marey.knee.space.surface import TriangleSurface


@dataclass(frozen=True, eq=False, kw_only=True)
class ScannedKnee:
    """Structures and markers of a knee in the scanner."""

    folder: Path
    """The folder from which they were read."""
    parts: Mapping[str, TriangleSurface]
    """Surfaces of bones and cartilages by name, LPS [mm]; no cartilage without its bone."""
    markers: ScannerMarkers
    """The gadolinium markers."""
    landmarks: Landmarks | None
    """Landmarks picked in the images; None if there are none."""
    left: bool | None
    """Whether it is a left knee; None where it is not known."""
    other_leg: bool = False
    """Whether the activity has the bones of the other leg only."""

    @property
    def bones(self) -> dict[str, TriangleSurface]:
        """The surfaces of the bones."""
        return {name: part for name, part in self.parts.items() if name in BONES}


def read_scanned_knee(
    folder: Path, activity: Activity, *, landmarks: Path | None = None, side: str | None = None
) -> ScannedKnee:
    """Read the structures and markers of the scanned knee, and find its side.

    Args:
        folder: A folder with the results of `marey knee segment`.
        activity: The motion of the bones beneath skin markers.
        landmarks: File of the landmarks picked in the images.
        side: `left` or `right`; by default the patella, or the names of the segments, decide.

    Raises:
        FileProblem: A file is missing or damaged.
    """
    if not folder.is_dir():
        raise FileProblem(folder, "is not a folder", "Give a folder with the results of `marey knee segment`.")
    parts = {name: read_mesh(folder / f"{name}.ply") for name in LABELS if (folder / f"{name}.ply").is_file()}
    parts = {name: part for name, part in parts.items() if BONE_OF_CARTILAGE.get(name, name) in parts}
    missing = [bone for bone in ("femur", "tibia") if bone not in parts]
    if missing:
        wrong = f"has no {' and no '.join(f'{bone}.ply' for bone in missing)}"
        raise FileProblem(folder, wrong, "Give a folder with the results of `marey knee segment`.")
    named = _named_sides(activity)
    left = is_left({name: part for name, part in parts.items() if name in BONES}) if side is None else side == "left"
    if left is None and len(named) == 1:
        left = next(iter(named))
    return ScannedKnee(
        folder=folder, parts=parts, markers=read_scanner_markers(folder / "markers.json"),
        landmarks=None if landmarks is None else read_landmarks(landmarks), left=left,
        other_leg=left is not None and bool(named) and left not in named,
    )  # fmt: skip


def _named_sides(activity: Activity) -> set[bool]:
    """Return whether the bones of the activity are those of a left knee, by their names; empty if they have no side."""
    named = {
        left
        for left in (True, False)
        for name in activity.motion.segments
        if bone_of_segment(name, left=left) is not None and bone_of_segment(name, left=not left) is None
    }
    return named if activity.side is None else named | {activity.side == "left"}
