"""Input of a run on a deforming surface: videos, tracks or points, checked together before the work begins."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats, Mask
from marey.cameras.camera import Camera
from marey.cameras.rig import Rig
from marey.errors import FileProblem, SettingProblem
from marey.geometry.rigid import RigidTransform
from marey.io.calibration.readers import read_rig
from marey.io.shapes.deforming_points import DeformingPoints, read_deforming, with_labels
from marey.io.shapes.tracks import read_points
from marey.io.video.take import COUNT_TOLERANCE, RATE_TOLERANCE
from marey.io.video.video import VIDEO_SUFFIXES, Clip, open_clip, read_picture
from marey.pipelines.nonrigid.settings import NonRigidSettings, parse_matrix

USUAL_RATE = 30.0
"""Sampling rate that is assumed where it is not given [Hz]; only the time of the frames depends on it."""
_NO_RATE = f"The input has no sampling rate: {USUAL_RATE:g} Hz is assumed. Only the time of the frames depends on it."
"""Note on an assumed sampling rate."""


@dataclass(frozen=True, eq=False, kw_only=True)
class NonRigidInput:
    """Videos, or tracks or points from files or arrays."""

    title: str
    """Name of the recording, for the report."""
    paths: tuple[Path, ...] = ()
    """The files; empty for arrays."""
    clips: tuple[Clip, ...] = ()
    """One video per camera."""
    data: tuple[DeformingPoints, ...] = ()
    """Tracks or points; several of them, one per camera, if the correspondence of their points is not known."""
    starts: tuple[tuple[Floats, int], ...] = ()
    """Points (P, 2) to follow and their frame: one per video, one for the first video, or none."""
    within: Mask | None = None
    """(H, W) true where points may be selected in the first video."""
    camera: Camera | None = None
    """Known intrinsics of a single camera, which is at the origin."""
    rig: Rig | None = None
    """The calibrated cameras, in the order of the videos or tracks."""
    names: tuple[str, ...] = ()
    """Names of the cameras; empty for points in space."""
    frames: int
    """Number F of frames in the recording."""
    first: int
    """First requested frame."""
    end: int
    """The frame after the last requested one."""
    rate: float
    """Sampling rate [Hz]."""
    notes: tuple[str, ...] = ()
    """What was skipped or decided, one sentence each."""

    @property
    def requested(self) -> slice:
        """The requested frames."""
        return slice(self.first, self.end)


def read_input(paths: Sequence[Path], settings: NonRigidSettings) -> NonRigidInput:
    """Read videos, tracks or points, and check that they fit each other and the settings.

    Args:
        paths: Videos, one per camera; one file of tracks or points; or one file of tracks per camera.
        settings: Settings of the run.

    Raises:
        FileProblem: A file cannot be used.
        SettingProblem: Files and settings do not fit each other.
    """
    for path in paths:
        if not path.is_file():
            wrong = "is a folder" if path.is_dir() else "does not exist"
            raise FileProblem(path, wrong, "Give videos, an NPZ of tracks or points, or a C3D.")
    videos = [path.suffix.lower() in VIDEO_SUFFIXES for path in paths]
    if all(videos):
        return _of_videos(paths, settings)
    if any(videos):
        raise SettingProblem("Give either videos, or files of tracks or points.")
    if settings.points or settings.mask:
        raise SettingProblem(
            "points (--points) and mask (--mask) are for videos; the points of this input are tracked already."
        )
    if len(paths) == 1:
        return input_of_data(read_deforming(paths[0]), settings, paths[0])
    return _of_cameras(paths, settings)


def input_of_data(data: DeformingPoints, settings: NonRigidSettings, path: Path | None = None) -> NonRigidInput:
    """Check tracks or points, and combine them with the settings.

    Args:
        data: Tracks or points.
        settings: Settings of the run.
        path: File of the tracks or points; None for arrays.

    Raises:
        SettingProblem: Data and settings do not fit each other.
    """
    title = "tracks" if path is None else path.stem
    if settings.only is not None:
        data = with_labels(data, settings.only)
    if data.tracks is not None:
        frames, names = data.tracks.shape[1], _view_names(title, len(data.tracks))
        _require_suitable(len(data.tracks), settings)
    else:
        assert data.points is not None
        frames, names = len(data.points), ()
        given = {"cameras": settings.cameras, "matrix": settings.matrix, "scaled": settings.scaled or None}
        for option in [name for name, value in given.items() if value is not None]:
            wrong = f"{option} (--{option}) is for tracks in images"
            raise SettingProblem(f"{wrong}; this input has points in space already.")
        if settings.distance is not None and data.unit == "m":
            raise SettingProblem("distance (--distance) gives a scale, but this input has lengths in metres already.")
    _require_points(data.labels, settings)
    first, end = _range(frames, settings)
    notes = list(data.notes)
    if data.rate is None:
        notes.append(_NO_RATE)
    return NonRigidInput(
        title=title, paths=() if path is None else (path,), data=(data,), names=names, frames=frames,
        first=first, end=end, rate=data.rate or USUAL_RATE, notes=tuple(notes),
        **_known_cameras(names, settings, data=data),
    )  # fmt: skip


def _of_cameras(paths: Sequence[Path], settings: NonRigidSettings) -> NonRigidInput:
    """Read the tracks of several cameras, one file each, whose correspondence is not known."""
    data = tuple(read_deforming(path) for path in paths)
    for path, one in zip(paths, data, strict=True):
        if one.tracks is None or len(one.tracks) != 1:
            what = "points in space" if one.tracks is None else f"tracks of {len(one.tracks)} cameras"
            raise FileProblem(
                path, f"has {what}", "If several files are given, each has `tracks` (frames, 2, points) of one camera."
            )
    _require_suitable(len(paths), settings)
    if settings.distance is not None or settings.only is not None:
        option = "distance (--distance)" if settings.distance is not None else "only (--only)"
        raise SettingProblem(f"{option} cannot be used with one file of tracks per camera.")
    frames = [one.tracks.shape[1] for one in data if one.tracks is not None]
    if len(set(frames)) > 1:
        raise SettingProblem(f"The files have {frames} frames; they should have the same number of frames.")
    names = tuple(path.stem for path in paths)
    if len(set(names)) < len(names):
        raise SettingProblem("Two files have the same name: name each file after its camera.")
    first, end = _range(frames[0], settings)
    rates = [one.rate for one in data if one.rate]
    if rates and max(rates) - min(rates) > RATE_TOLERANCE * max(rates):
        raise SettingProblem(f"The sampling rates of the files differ: {min(rates):g} and {max(rates):g} Hz.")
    notes = [note for one in data for note in one.notes]
    return NonRigidInput(
        title=paths[0].stem, paths=tuple(paths), data=data, names=names, frames=frames[0], first=first, end=end,
        rate=rates[0] if rates else USUAL_RATE, notes=tuple(notes), **_known_cameras(names, settings),
    )  # fmt: skip


def _view_names(title: str, count: int) -> tuple[str, ...]:
    return (title,) if count == 1 else tuple(f"camera {number}" for number in range(count))


def _require_points(labels: Sequence[str], settings: NonRigidSettings) -> None:
    if settings.distance is not None and max(settings.distance[:2]) >= len(labels):
        raise SettingProblem(
            f"distance (--distance) has the point {max(settings.distance[:2])}; there are the points "
            f"0 to {len(labels) - 1}."
        )


def _require_suitable(count: int, settings: NonRigidSettings) -> None:
    """Raise an error for settings that do not suit the number of cameras."""
    if count > 1 and settings.matrix is not None:
        raise SettingProblem(
            f"matrix (--matrix) is for a single camera, and there are {count}: give cameras (--cameras), or neither."
        )
    if count > 1 and settings.scaled:
        raise SettingProblem(
            f"scaled (--scaled) is for a single camera; with {count} cameras the scale is always estimated."
        )
    calibrated = count > 1 and settings.cameras is not None
    if settings.basis_shapes is not None and not calibrated:
        raise SettingProblem(
            "basis_shapes (--basis-shapes) is for points in space and calibrated cameras; otherwise it is estimated."
        )
    if settings.distance is not None and calibrated:
        raise SettingProblem("distance (--distance) gives a scale, but calibrated cameras have one already.")


def _known_cameras(
    names: Sequence[str], settings: NonRigidSettings, *, sizes: Sequence[tuple[int, int]] = (),
    data: DeformingPoints | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Return the camera or the rig of the settings; the cameras of the rig are found by the names of the files.

    Tracks of several cameras in one file have no names; they are in the order of the calibration.
    """
    if settings.matrix is not None:
        matrix = parse_matrix(settings.matrix)
        size = sizes[0] if sizes else tuple(max(1, round(2 * float(middle)) + 1) for middle in matrix[:2, 2])
        return {"camera": Camera(
            name=names[0], size=(size[0], size[1]), matrix=matrix, distortion=np.zeros(0),
            camera_from_world=RigidTransform.identity(),
        )}  # fmt: skip
    if settings.cameras is None:
        return {}
    rig = _rig_of(read_rig(settings.cameras), names, settings.cameras, named=len(names) == 1 or data is None)
    for camera, size in zip(rig, sizes, strict=False):
        if camera.size != size:
            wrong = f"calibrates '{camera.name}' at {camera.size[0]} x {camera.size[1]}"
            raise FileProblem(settings.cameras, wrong, f"The frames of the video have {size[0]} x {size[1]} pixels.")
    if len(rig) > 1:
        return {"rig": rig}
    return {"camera": replace(rig.cameras[0], camera_from_world=RigidTransform.identity())}


def _rig_of(rig: Rig, names: Sequence[str], path: Path, *, named: bool) -> Rig:
    if named and set(names) <= set(rig.names):
        return Rig(tuple(rig[name] for name in names))
    if len(rig) == len(names) and (not named or len(rig) == 1):
        return rig
    if named:
        wrong = f"has the cameras {', '.join(rig.names)}, not {', '.join(names)}"
        raise FileProblem(path, wrong, "Name each video, or file of tracks, after its camera.")
    wrong = f"has {len(rig)} cameras, and the tracks are of {len(names)}"
    raise FileProblem(path, wrong, "Give the calibration of these cameras.")


def _range(frames: int, settings: NonRigidSettings) -> tuple[int, int]:
    first, end = settings.frames or (0, frames)
    if end > frames:
        raise SettingProblem(f"The range of frames (--frames) is {first}:{end}, but there are {frames} frames.")
    return first, end


def _of_videos(paths: Sequence[Path], settings: NonRigidSettings) -> NonRigidInput:
    _require_suitable(len(paths), settings)
    if settings.only is not None:
        raise SettingProblem("only (--only) is for points with labels, not for videos.")
    if len(settings.points) not in (0, 1, len(paths)):
        raise SettingProblem(
            f"points (--points) is given {len(settings.points)} times for {len(paths)} videos: give it once, "
            "for the first one, "
            "or once per video, in the same order."
        )
    clips = tuple(open_clip(path) for path in paths)
    names = tuple(path.stem for path in paths)
    if len(set(names)) < len(names):
        raise SettingProblem("Two videos have the same name: name each video after its camera.")
    count, notes = _common_count(paths, clips, settings)
    first, end = _range(count, settings)
    if end - first < 2:
        raise FileProblem(
            paths[0], f"has {end - first} requested frame", "Give at least two frames to follow points through."
        )
    rate, more = _common_rate(paths, clips)
    starts = tuple(
        _start(path, clip, first, end) for path, clip in zip(settings.points, clips, strict=False)
    )  # fmt: skip
    if starts:
        counts = [len(points) for points, _ in starts]
        if len(set(counts)) > 1:
            raise SettingProblem(
                f"The files with points (--points) have {counts} points; they should have the same "
                "points for every camera."
            )
        _require_points(tuple(map(str, range(counts[0]))), settings)
    return NonRigidInput(
        title=paths[0].stem, paths=tuple(paths), clips=clips, starts=starts, within=_within(settings, clips),
        names=names, frames=count, first=first, end=end, rate=rate, notes=(*notes, *more),
        **_known_cameras(names, settings, sizes=[clip.size for clip in clips]),
    )  # fmt: skip


def _start(path: Path, clip: Clip, first: int, end: int) -> tuple[Floats, int]:
    points, frame = read_points(path, frames=clip.count, size=clip.size)
    if not first <= frame < end:
        raise FileProblem(path, f"has points of frame {frame}", f"The requested frames are {first} to {end - 1}.")
    return points, frame


def _within(settings: NonRigidSettings, clips: Sequence[Clip]) -> Mask | None:
    if settings.mask is None:
        return None
    image = read_picture(settings.mask)
    if (image.shape[1], image.shape[0]) != clips[0].size:
        wide, high = clips[0].size
        wrong = f"has {image.shape[1]} x {image.shape[0]} pixels"
        raise FileProblem(settings.mask, wrong, f"The frames of the video have {wide} x {high}.")
    within = np.asarray(image.max(2) > 127)
    if not within.any():
        raise FileProblem(settings.mask, "is entirely black", "It should be white where points may be selected.")
    return within


def _common_count(
    paths: Sequence[Path], clips: Sequence[Clip], settings: NonRigidSettings
) -> tuple[int, tuple[str, ...]]:
    """Return the number of frames that all videos have; videos of very different length are not of one recording."""
    counts = [clip.count for clip in clips]
    least, most = min(counts), max(counts)
    if most - least > COUNT_TOLERANCE and (settings.frames is None or settings.frames[1] > least):
        each = ", ".join(f"{path.name} {count}" for path, count in zip(paths, counts, strict=True))
        wrong = f"is shorter than the others ({each} frames)"
        remedy = f"Cut the videos to the same time span, or select the frames 0 to {least} (--frames 0:{least})."
        raise FileProblem(paths[counts.index(least)], wrong, remedy)
    if most > least:
        return least, (f"The videos have {least} to {most} frames; only the first {least} are used.",)
    return least, ()


def _common_rate(paths: Sequence[Path], clips: Sequence[Clip]) -> tuple[float, tuple[str, ...]]:
    known = [clip.rate for clip in clips if clip.rate]
    if not known:
        return USUAL_RATE, (_NO_RATE,)
    if max(known) - min(known) > RATE_TOLERANCE * max(known):
        each = ", ".join(f"{path.name} {clip.rate or 0:g}" for path, clip in zip(paths, clips, strict=True))
        wrong = f"has another frame rate than the others ({each} Hz)"
        slowest = [clip.rate for clip in clips].index(min(known))
        raise FileProblem(paths[slowest], wrong, "All cameras should record at the same rate.")
    return known[0], ()
