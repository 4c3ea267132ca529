"""The files of an animated knee: numbers, a moving mesh, a video and a page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.geometry import rotations
from marey.io.axes import OPENSIM_FROM_WORLD
from marey.io.mr.correspondence import write_correspondence
from marey.io.mr.knee_glb import ColouredPart, write_knee_glb
from marey.io.mr.knee_motion import write_knee_motion, write_proximity
from marey.io.video.video_writer import VideoWriter
from marey.knee.markers.correspondence import KneeCorrespondence
from marey.knee.motion.joint_motion import BASE, KneeMotion
from marey.knee.space.structures import BONE_OF_CARTILAGE
from marey.knee.space.surface import TriangleSurface
from marey.markers.kinematics.transform_chain import NamedTransform
from marey.pipelines.progress import Progress
from marey.pipelines.run_details import RunDetails, page_head
from marey.pipelines.run_record import finished_together, write_record
from marey.view.pages.html import Still
from marey.view.pages.knee_report import KneeReport, distances_of, write_knee_report
from marey.view.pictures.knee_maps import BONE, proximity_colours
from marey.view.pictures.knee_picture import DrawnPart, KneeCamera, KneeInstant, KneePicture, axes_of_view

RESULTS = ("knee.html", "knee_motion.npz", "proximity.csv", "correspondence.json")
"""Files that every run writes, whose names are checked before the work."""
_MOST_PICTURES_HZ = 30.0
"""Highest frame rate of the video [Hz]. Chosen by hand."""
_SAMPLED = 60
"""Number of frames from which the part of the room in the video is chosen.

Chosen by hand; results were not measured against other values.
"""


@dataclass(frozen=True, eq=False, kw_only=True)
class AnimationResults:
    """Everything that the files of an animated knee contain, apart from the details of the run."""

    title: str
    """Name of knee and activity, for the page."""
    parts: Mapping[str, TriangleSurface]
    """Surfaces of bones and cartilages by name, LPS [mm]."""
    found: KneeMotion
    """Motion and distances by the method that was chosen."""
    compared: KneeMotion | None
    """The same by another method, for comparison."""
    joined: KneeCorrespondence
    """The relation between scanner and laboratory."""
    in_room: bool
    """Whether the room is held in place in video and GLB, instead of the tibia."""
    y_up: bool
    """Whether Y points up in the laboratory; otherwise Z does."""
    views: Sequence[str]
    """Views of the video."""
    limit_mm: float
    """Distance below which two cartilages count as near [mm]."""

    @property
    def poses(self) -> dict[str, NamedTransform]:
        """Pose of each bone in video and GLB [mm]."""
        motion = self.found.motion
        return dict(motion.poses) if self.in_room else {bone: motion.held(bone) for bone in motion.bones}


def write_animation(results: AnimationResults, details: RunDetails, out: Path, progress: Progress) -> None:
    """Write all results at once.

    Args:
        results: The animated knee.
        details: Settings, inputs, warnings and times of the run.
        out: The folder.
        progress: Progress reporter; its times and warnings are on the page.
    """
    found, compared = results.found, results.compared
    with finished_together(out, inputs=details.inputs) as folder:
        with progress.stage("Numbers"):
            write_knee_motion(folder / "knee_motion.npz", found, compared)
            write_proximity(folder / "proximity.csv", found, compared)
            write_correspondence(folder / "correspondence.json", results.joined)
            _write_glb(folder / "knee.glb", results)
        stills = _write_video(folder / "knee.mp4", results, progress)
        with progress.stage("Page"):
            write_knee_report(
                folder / "knee.html",
                KneeReport(
                    title=results.title, parts=_drawn(results, all_bones=True), found=found, compared=compared,
                    carried=_carried(results), in_room=results.in_room,
                    # OpenSim's axes are those of a room with Y up.
                    upright=OPENSIM_FROM_WORLD.T if results.y_up else np.eye(3), notes=progress.warnings,
                    stills=stills, timings=progress.timings, settings=details.settings,
                    files=[path.name for path in folder.iterdir()],
                    head=page_head(details.command, details.verdict),
                ),
            )  # fmt: skip
        write_record(
            folder, command=details.command, settings=details.settings, inputs=details.inputs, root=details.root,
            progress=progress, verdict=details.verdict,
        )  # fmt: skip


def _carried(results: AnimationResults) -> list[str]:
    """List the bones that were not measured, and can be drawn with the femur."""
    moved = results.found.motion.poses
    return [bone for bone in ("patella",) if bone in results.parts and bone not in moved and "femur" in moved]


def _drawn(results: AnimationResults, *, all_bones: bool = False) -> dict[str, DrawnPart]:
    """Choose the structures to draw: those that move, and on the page also those that are drawn with the femur."""
    bones = {*results.found.motion.poses, *(_carried(results) if all_bones else ())}
    return {
        name: DrawnPart(bone=BONE_OF_CARTILAGE.get(name, name), surface=surface, cartilage=name in BONE_OF_CARTILAGE)
        for name, surface in results.parts.items()
        if BONE_OF_CARTILAGE.get(name, name) in bones
    }


def _write_glb(path: Path, results: AnimationResults) -> None:
    """Write the moving meshes, with the cartilage coloured by the least distance over the activity."""
    parts = {}
    for name, part in _drawn(results).items():
        colours = np.broadcast_to(np.array(BONE, np.uint8), (len(part.surface.vertices_mm), 3))
        if part.cartilage:
            found = distances_of(name, results.found)
            least = np.full(len(part.surface.vertices_mm), np.nan)
            if found is not None:
                least[found[0]] = np.fmin.reduce(found[1])
            colours = proximity_colours(least, results.limit_mm)
        parts[name] = ColouredPart(
            bone=part.bone, surface=part.surface, colours=colours, see_through=not part.cartilage
        )  # fmt: skip
    balls = {
        f"centre of proximity, {joint.name} {name}": (bone, joint.centre_mm[:, c])
        for joint in results.found.joints
        for bone in (BONE_OF_CARTILAGE.get(joint.base.name, joint.base.name),)
        for c, name in enumerate(joint.compartments)
    }
    write_knee_glb(
        path, parts, results.poses, results.found.motion.time, balls=balls, y_up=results.in_room and results.y_up
    )  # fmt: skip


def _write_video(path: Path, results: AnimationResults, progress: Progress) -> list[Still]:
    """Write the video with at most 30 frames per second, and return three of its frames for the page."""
    motion = results.found.motion
    rate = 1 / float(np.median(np.diff(motion.time))) if len(motion) > 1 else 1.0
    stride = max(1, int(np.ceil(rate / _MOST_PICTURES_HZ - 1e-6)))
    frames = np.arange(0, len(motion), stride)
    film = _Film(results)
    known = [f for f in frames.tolist() if film.answered(f)]
    wanted = {known[k] for k in (0, len(known) // 2, len(known) - 1)} if known else set()
    stills = []
    with progress.stage("Video", len(frames)) as step, VideoWriter(path, film.size, rate=rate / stride) as video:
        for frame in frames.tolist():
            picture = film.draw(frame)
            video.add(picture)
            if frame in wanted:
                stills.append(Still(caption=f"frame {frame}, {motion.time[frame]:.2f} s", image=picture))
            step()
    return stills


class _Film:
    """The images of an activity."""

    def __init__(self, results: AnimationResults):
        self._results, self._poses = results, results.poses
        self._parts = _drawn(results)
        self._matrices = {bone: pose.matrix() for bone, pose in self._poses.items()}
        if results.in_room:
            self._follow()
        self._maps = {name: distances_of(name, results.found) for name, p in self._parts.items() if p.cartilage}
        held = "In the room; the camera follows the knee." if results.in_room else "The tibia is held in place."
        note = f"Method {results.found.method}. {held}"
        cameras = {view: self._camera(view) for view in results.views}
        self._picture = KneePicture(self._parts, cameras, limit_mm=results.limit_mm, note=note)

    @property
    def size(self) -> tuple[int, int]:
        return self._picture.size

    def answered(self, frame: int) -> bool:
        return all(np.isfinite(self._at(bone, frame)).all() for bone in self._poses)

    def _at(self, bone: str, frame: int) -> Floats:
        matrix = self._matrices[bone]
        return matrix if matrix.ndim == 2 else matrix[frame]

    def _follow(self) -> None:
        """Let the camera follow the knee without rotation: subtract the place of the tibia, or of another bone."""
        way = np.full((len(self._results.found.motion), 3), np.nan)
        for bone in sorted(self._poses, key=lambda name: name != BASE):
            middle = self._results.parts[bone].vertices_mm.mean(0)
            way = np.where(np.isfinite(way), way, self._poses[bone].apply(middle[None])[:, 0])
        for matrix in self._matrices.values():
            matrix[:, :3, 3] -= way

    def _camera(self, view: str) -> KneeCamera:
        """Look along the axes of the tibia, or in the room along those of its mean orientation."""
        axes = axes_of_view(view, left=self._results.found.motion.left)
        if self._results.in_room:
            bone = BASE if BASE in self._poses else next(iter(self._poses))
            turns = self._poses[bone].rotation
            known = turns[np.isfinite(turns).all((1, 2))]
            if len(known):
                axes = axes @ rotations.mean(known).T
        return KneeCamera(axes, self._corners(view))

    def _corners(self, view: str) -> Floats:
        """Return the corners (N, 3) of the bones' boxes over the activity, which must be in the image."""
        found = [np.full((1, 3), np.nan)]
        frames = np.unique(np.linspace(0, len(self._results.found.motion) - 1, _SAMPLED).astype(int))
        for part in self._parts.values():
            if part.cartilage or (view == "plateau" and part.bone != BASE):
                continue
            low, high = part.surface.vertices_mm.min(0), part.surface.vertices_mm.max(0)
            box = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
            for frame in frames:
                matrix = self._at(part.bone, frame)
                found.append(box @ matrix[:3, :3].T + matrix[:3, 3])
        return np.concatenate(found)

    def draw(self, frame: int) -> np.ndarray:
        motion = self._results.found.motion
        poses = {bone: self._at(bone, frame) for bone in self._poses}
        poses = {bone: matrix for bone, matrix in poses.items() if np.isfinite(matrix).all()}
        distances = {}
        for name, found in self._maps.items():
            distances[name] = np.full(len(self._parts[name].surface.vertices_mm), np.nan)
            if found is not None:
                distances[name][found[0]] = found[1][frame]
        return self._picture.draw(
            KneeInstant(
                caption=f"frame {frame}   {motion.time[frame]:.2f} s", poses=poses, distance_mm=distances,
                paths_mm=self._paths(frame),
            )
        )  # fmt: skip

    def _paths(self, frame: int) -> list[Floats]:
        """Return the paths of the contact centres on the tibia up to a frame, at the place of the tibia in it."""
        if BASE not in self._poses:
            return []
        matrix = self._at(BASE, frame)
        return [
            joint.centre_mm[: frame + 1, c] @ matrix[:3, :3].T + matrix[:3, 3]
            for joint in self._results.found.joints
            if joint.base.name in (BASE, "tibial_cartilage")
            for c in range(len(joint.compartments))
        ]
