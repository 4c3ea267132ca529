"""What a run on a deforming surface is given: videos, tracks or points, checked together before the work begins."""

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
from marey.io.shapes.deforming_points import DeformingPoints, only, read_deforming
from marey.io.shapes.tracks import read_points
from marey.io.video.video import VIDEO_SUFFIXES, Clip, open_clip, read_picture
from marey.pipelines.nonrigid.settings import NonRigidOptions, parse_matrix

USUAL_RATE = 30.0
"""Taken where no file says one; it only sets the clock [Hz]."""
_MOST_LEFT = 3
"""Frames by which videos of one scene may differ at their ends."""
_RATE_SLACK = 0.005


@dataclass(frozen=True, eq=False, kw_only=True)
class NonRigidInput:
    """What was given; videos, or what a file holds."""

    paths: tuple[Path, ...]
    clips: tuple[Clip, ...] = ()
    """One a camera."""
    data: tuple[DeformingPoints, ...] = ()
    """What files hold; of several files, one a camera, nobody says which points are the same."""
    starts: tuple[tuple[Floats, int], ...] = ()
    """Points (P, 2) to follow and their frame, one a video or of the first alone; empty where the program chooses."""
    within: Mask | None = None
    """(H, W) where points may be chosen in the first video."""
    camera: Camera | None = None
    """Known intrinsics of the one camera, which stands at the origin."""
    rig: Rig | None = None
    """The calibrated cameras, in the order of the videos or tracks."""
    names: tuple[str, ...] = ()
    """Of the cameras; empty from points in space."""
    frames: int
    """F of the recording."""
    first: int
    end: int
    """The frames that are asked for, without this one."""
    rate: float
    """[Hz]."""
    notes: tuple[str, ...] = ()
    """What was decided."""

    @property
    def asked(self) -> slice:
        """The frames that are asked for."""
        return slice(self.first, self.end)


def read_input(paths: Sequence[Path], options: NonRigidOptions) -> NonRigidInput:
    """Read what was given, and check that it goes together.

    Raises:
        FileProblem: A file cannot be used.
        SettingProblem: Files and options do not go together.
    """
    for path in paths:
        if not path.is_file():
            wrong = "is a folder" if path.is_dir() else "does not exist"
            raise FileProblem(path, wrong, "Give videos, an NPZ of tracks or points, or a C3D.")
    videos = [path.suffix.lower() in VIDEO_SUFFIXES for path in paths]
    if all(videos):
        return _of_videos(paths, options)
    if any(videos):
        raise SettingProblem("Give either videos, or files of tracks or points.")
    if options.points or options.mask:
        raise SettingProblem("--points and --mask are for videos; here points were followed already.")
    return _of_data(paths[0], options) if len(paths) == 1 else _of_cameras(paths, options)


def _of_data(path: Path, options: NonRigidOptions) -> NonRigidInput:
    data = read_deforming(path)
    if options.only is not None:
        data = only(data, options.only)
    if data.tracks is not None:
        frames, names = data.tracks.shape[1], _view_names(path, len(data.tracks))
        _require_suitable(len(data.tracks), options)
    else:
        assert data.points is not None
        frames, names = len(data.points), ()
        given = {"--cameras": options.cameras, "--matrix": options.matrix, "--scaled": options.scaled or None}
        for option in [name for name, value in given.items() if value is not None]:
            raise SettingProblem(f"{option} is for tracks in pictures; {path.name} holds points in space already.")
        if options.distance is not None and data.unit == "m":
            raise SettingProblem(f"--distance gives a scale, but {path.name} says its own unit.")
    _require_points(data.labels, options)
    first, end = _range(path, frames, options)
    notes = list(data.notes)
    if data.rate is None:
        notes.append(f"The file says no rate: {USUAL_RATE:g} Hz is taken. It only sets the clock.")
    return NonRigidInput(
        paths=(path,), data=(data,), names=names, frames=frames, first=first, end=end, rate=data.rate or USUAL_RATE,
        notes=tuple(notes), **_known_cameras(names, options, data=data),
    )  # fmt: skip


def _of_cameras(paths: Sequence[Path], options: NonRigidOptions) -> NonRigidInput:
    """Take tracks of several cameras, a file each, of which nobody says which points are the same."""
    data = tuple(read_deforming(path) for path in paths)
    for path, one in zip(paths, data, strict=True):
        if one.tracks is None or len(one.tracks) != 1:
            what = "points in space" if one.tracks is None else f"tracks of {len(one.tracks)} cameras"
            raise FileProblem(
                path, f"holds {what}", "Of several files, each holds `tracks` (frames, 2, points) of a camera."
            )
    _require_suitable(len(paths), options)
    if options.distance is not None or options.only is not None:
        option = "--distance" if options.distance is not None else "--only"
        raise SettingProblem(f"{option} does not go with tracks whose points are yet to be matched.")
    frames = [one.tracks.shape[1] for one in data if one.tracks is not None]
    if len(set(frames)) > 1:
        raise SettingProblem(f"The files have {frames} frames; the cameras must show the same instants.")
    names = tuple(path.stem for path in paths)
    if len(set(names)) < len(names):
        raise SettingProblem("Two files have one name: give them names of their cameras.")
    first, end = _range(paths[0], frames[0], options)
    rates = [one.rate for one in data if one.rate]
    if rates and max(rates) - min(rates) > _RATE_SLACK * max(rates):
        raise SettingProblem(f"The files say rates of {min(rates):g} and {max(rates):g} Hz.")
    notes = [note for one in data for note in one.notes]
    return NonRigidInput(
        paths=tuple(paths), data=data, names=names, frames=frames[0], first=first, end=end,
        rate=rates[0] if rates else USUAL_RATE, notes=tuple(notes), **_known_cameras(names, options),
    )  # fmt: skip


def _view_names(path: Path, count: int) -> tuple[str, ...]:
    return (path.stem,) if count == 1 else tuple(f"camera {number}" for number in range(count))


def _require_points(labels: Sequence[str], options: NonRigidOptions) -> None:
    if options.distance is not None and max(options.distance[:2]) >= len(labels):
        raise SettingProblem(
            f"--distance names the point {max(options.distance[:2])}; the points count from 0 to {len(labels) - 1}."
        )


def _require_suitable(count: int, options: NonRigidOptions) -> None:
    """Refuse options that do not suit tracks of so many cameras."""
    if count > 1 and options.matrix is not None:
        raise SettingProblem(f"--matrix is for one camera, and there are {count}: give --cameras, or neither.")
    if count > 1 and options.scaled:
        raise SettingProblem(f"--scaled is for one camera, and there are {count}: their videos are scaled anyway.")
    calibrated = count > 1 and options.cameras is not None
    if options.basis_shapes is not None and not calibrated:
        raise SettingProblem("--basis-shapes is for points in space and calibrated cameras; here the data choose.")
    if options.distance is not None and calibrated:
        raise SettingProblem("--distance gives a scale, but calibrated cameras have one.")


def _known_cameras(
    names: Sequence[str], options: NonRigidOptions, *, sizes: Sequence[tuple[int, int]] = (),
    data: DeformingPoints | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Give the camera, or the rig, that the options say; the rig's cameras by the names of videos and files.

    Tracks of several cameras in one file have no names: they are in the order of the calibration.
    """
    if options.matrix is not None:
        matrix = parse_matrix(options.matrix)
        size = sizes[0] if sizes else tuple(max(1, round(2 * float(middle)) + 1) for middle in matrix[:2, 2])
        return {"camera": Camera(
            name=names[0], size=(size[0], size[1]), matrix=matrix, distortion=np.zeros(0),
            camera_from_world=RigidTransform.identity(),
        )}  # fmt: skip
    if options.cameras is None:
        return {}
    rig = _rig_of(read_rig(options.cameras), names, options.cameras, named=len(names) == 1 or data is None)
    for camera, size in zip(rig, sizes, strict=False):
        if camera.size != size:
            wrong = f"calibrates '{camera.name}' at {camera.size[0]} x {camera.size[1]}"
            raise FileProblem(options.cameras, wrong, f"The video's pictures have {size[0]} x {size[1]} pixels.")
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
        raise FileProblem(path, wrong, "Videos and files of tracks are called as their cameras.")
    raise FileProblem(path, f"has {len(rig)} cameras for tracks of {len(names)}", "Give the calibration of these.")


def _range(path: Path, frames: int, options: NonRigidOptions) -> tuple[int, int]:
    first, end = options.frames or (0, frames)
    if end > frames:
        raise SettingProblem(f"--frames is {first}:{end}; {path.name} has {frames} frames.")
    return first, end


def _of_videos(paths: Sequence[Path], options: NonRigidOptions) -> NonRigidInput:
    _require_suitable(len(paths), options)
    if options.only is not None:
        raise SettingProblem("--only is for files of points that have labels, not for videos.")
    if len(options.points) not in (0, 1, len(paths)):
        raise SettingProblem(
            f"--points is given {len(options.points)} times for {len(paths)} videos: give it once, for the first one, "
            "or once for each, in their order."
        )
    clips = tuple(open_clip(path) for path in paths)
    names = tuple(path.stem for path in paths)
    if len(set(names)) < len(names):
        raise SettingProblem("Two videos have one name: give them names of their cameras.")
    count, notes = _common_count(paths, clips, options)
    first, end = _range(paths[0], count, options)
    if end - first < 2:
        raise FileProblem(
            paths[0], f"has {end - first} frame that is asked for", "Points are followed through several."
        )
    rate, more = _common_rate(paths, clips)
    starts = tuple(
        _start(path, clip, first, end) for path, clip in zip(options.points, clips, strict=False)
    )  # fmt: skip
    if starts:
        counts = [len(points) for points, _ in starts]
        if len(set(counts)) > 1:
            raise SettingProblem(
                f"The files of --points hold {counts} points; the cameras are to follow the same ones."
            )
        _require_points(tuple(map(str, range(counts[0]))), options)
    return NonRigidInput(
        paths=tuple(paths), clips=clips, starts=starts, within=_within(options, clips), names=names, frames=count,
        first=first, end=end, rate=rate, notes=(*notes, *more),
        **_known_cameras(names, options, sizes=[clip.size for clip in clips]),
    )  # fmt: skip


def _start(path: Path, clip: Clip, first: int, end: int) -> tuple[Floats, int]:
    points, frame = read_points(path, frames=clip.count, size=clip.size)
    if not first <= frame < end:
        raise FileProblem(path, f"has points of frame {frame}", f"The frames {first} to {end - 1} are asked for.")
    return points, frame


def _within(options: NonRigidOptions, clips: Sequence[Clip]) -> Mask | None:
    if options.mask is None:
        return None
    image = read_picture(options.mask)
    if (image.shape[1], image.shape[0]) != clips[0].size:
        wide, high = clips[0].size
        wrong = f"has {image.shape[1]} x {image.shape[0]} pixels"
        raise FileProblem(options.mask, wrong, f"The video's pictures have {wide} x {high}.")
    within = np.asarray(image.max(2) > 127)
    if not within.any():
        raise FileProblem(options.mask, "is black all over", "It should be white where points may be chosen.")
    return within


def _common_count(
    paths: Sequence[Path], clips: Sequence[Clip], options: NonRigidOptions
) -> tuple[int, tuple[str, ...]]:
    """Agree on the number of frames; videos that differ by more than their ends are not of one recording."""
    counts = [clip.count for clip in clips]
    least, most = min(counts), max(counts)
    if most - least > _MOST_LEFT and (options.frames is None or options.frames[1] > least):
        each = ", ".join(f"{path.name} {count}" for path, count in zip(paths, counts, strict=True))
        wrong = f"is shorter than the others ({each} frames)"
        remedy = f"Cut them to the same instants, or keep what all have with --frames 0:{least}."
        raise FileProblem(paths[counts.index(least)], wrong, remedy)
    if most > least:
        return least, (f"The videos have {least} to {most} frames; what not all of them have is left out.",)
    return least, ()


def _common_rate(paths: Sequence[Path], clips: Sequence[Clip]) -> tuple[float, tuple[str, ...]]:
    known = [clip.rate for clip in clips if clip.rate]
    if not known:
        return USUAL_RATE, (f"The video says no rate: {USUAL_RATE:g} Hz is taken. It only sets the clock.",)
    if max(known) - min(known) > _RATE_SLACK * max(known):
        each = ", ".join(f"{path.name} {clip.rate or 0:g}" for path, clip in zip(paths, clips, strict=True))
        wrong = f"has another rate than the others ({each} frames a second)"
        slowest = [clip.rate for clip in clips].index(min(known))
        raise FileProblem(paths[slowest], wrong, "The cameras must have filmed together at one rate.")
    return known[0], ()
