"""Reading of a trial: the folder with calibration, videos, silhouettes and the settings of trial.toml."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np
from pydantic import ValidationError

from marey.arrays import Floats
from marey.cameras.clocks import Clocks
from marey.cameras.rig import Rig
from marey.cameras.shutter import RollingShutter
from marey.errors import FileProblem, MareyError
from marey.geometry.rigid import RigidTransform
from marey.io.calibration.covariance import COVARIANCE_FILE, read_camera_covariance
from marey.io.calibration.readers import calibration_file, calibration_parts, read_rig
from marey.io.trial.clocks import CLOCKS_FILE, read_clocks
from marey.io.trial.layout import TrialLayout, find_layout, stated_calibration, upward_axis, video_places
from marey.io.trial.masks import MaskFile, open_masks, require_no_results
from marey.io.trial.person_choice import PersonChoice, check_person, parse_person
from marey.io.trial.person_network import PersonNetwork, open_person_network
from marey.io.trial.settings import (
    BackgroundTable,
    KeyPointsTable,
    MasksTable,
    PeopleTable,
    StartTable,
    TrialSettings,
    read_settings,
    setting_faults,
)
from marey.io.trial.shutter import shutter_of
from marey.io.video.clip_files import files_named, fitting_clip, require_size
from marey.io.video.common_frames import SelectedPictures
from marey.io.video.take import Take, open_free_take, open_take
from marey.io.video.timestamps import timestamp_files
from marey.io.video.video import PICTURE_SUFFIXES, VIDEO_SUFFIXES, Clip, open_clip

_Z_UP_FROM: dict[str, list[list[int]]] = {
    "z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-z": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "-y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "x": [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
    "-x": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
}
"""Rotation by a quarter or half turn that maps the given axis to Z."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Trial:
    """A trial folder with all its files opened and checked, in a world whose Z points up.

    With `[world] up`, the calibration is rotated so that the given axis becomes Z; all results are in the rotated
    world, which has the same origin. `world_from_file` is the transform from the axes of the calibration file.
    """

    folder: Path
    calibration: Path
    """The calibration file."""
    rig: Rig
    """The cameras that are used, in the world with Z up."""
    take: Take
    """The clips of the cameras, in the same order."""
    background: Mapping[str, Clip]
    """Images of the empty room by camera; cameras without one are omitted."""
    masks: Mapping[str, MaskFile]
    """Given silhouettes by camera that are those of the result: of all cameras, or none."""
    evidence: Mapping[str, MaskFile]
    """Given silhouettes by camera that are evidence only; cameras without any are omitted."""
    network: PersonNetwork | None
    """A network that segments people; None if not given."""
    start: Path | None
    """File or folder of the 2-D joints of the first pose; None if not given."""
    keypoints: Path | None
    """Folder with the detected joints of all images; None if not given."""
    follow: PersonChoice | None
    """The person to follow; None for the one who is seen best."""
    settings: TrialSettings
    world_from_file: RigidTransform
    """Identity unless `[world] up` turns the calibration."""
    up_given: bool
    """Whether the user gave the vertical axis; then the person is not assumed to stand."""
    clocks: Clocks | None = None
    """The clocks of the cameras from `sync.json` or files of timestamps; None if they have one clock."""
    file_names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Names that other files of a camera may have, by camera: its own name, and that of its video."""
    shutter: RollingShutter | None = None
    """The cameras' rolling shutters; None if all rows of a picture are of one instant."""
    camera_covariance: Floats | None = None
    """(15 C, 15 C) covariance of the cameras' parameters from calibration.json; None if it is not known."""

    def __repr__(self) -> str:
        cameras = ", ".join(self.rig.names)
        silhouettes = self.masks or self.evidence
        known = [name for name, held in (("background", self.background), ("silhouettes", silhouettes)) if held]
        given = f"; with {' and '.join(known)}" if known else ""
        return (
            f"Trial {self.folder.resolve().name}: {len(self.rig)} cameras ({cameras}), frames {self.take.first} to "
            f"{self.take.end - 1} of {self.take.count} at {self.take.rate:g} Hz{given}"
        )

    @property
    def input_files(self) -> tuple[Path, ...]:
        """All files on which the results depend."""
        named = [*calibration_parts(self.calibration), self.folder / "trial.toml"]
        named += [] if self.clocks is None or self.settings.sync == "off" else [self.folder / CLOCKS_FILE]
        named += timestamp_files(self.folder, self.rig.names)
        named += [] if self.camera_covariance is None else [self.calibration.parent / COVARIANCE_FILE]
        named += [path for file in (*self.masks.values(), *self.evidence.values()) for path in file.paths]
        named += [] if self.network is None else [self.network.path]
        named += [path for clip in (*self.take.clips, *self.background.values()) for path in clip.paths]
        named += [] if self.start is None else [self.start]
        named += [] if self.keypoints is None else sorted(self.keypoints.rglob("*.json"))
        return tuple(path for path in named if path.is_file())


def read_trial(folder: Path | str, **changes: object) -> Trial:
    """Open a trial: its settings, cameras, clips, background and given silhouettes.

    Args:
        folder: The trial.
        **changes: Settings by name that replace those of trial.toml; None leaves the file's.

    Returns:
        The trial.

    Raises:
        FileProblem: A file of the trial cannot be used; the message names the file and the remedy.
        SettingProblem: A replacement is invalid.
    """
    layout = find_layout(Path(folder))
    return _opened(layout, _settings(layout, changes))


def read_free_trial(folder: Path | str, **changes: object) -> Trial:
    """Open a trial of whose cameras' clocks nothing is known: its videos may have different lengths and rates.

    Args:
        folder: The trial; a sync.json in it is ignored.
        **changes: Settings by name that replace those of trial.toml; None leaves the file's.

    Returns:
        The trial, see `marey.io.video.take.open_free_take`.

    Raises:
        FileProblem: A file of the trial cannot be used; the message names the file and the remedy.
        SettingProblem: A replacement is invalid.
    """
    layout = find_layout(Path(folder))
    return _opened(layout, _settings(layout, changes), free=True)


def with_clocks(trial: Trial, clocks: Clocks) -> Trial:
    """Open a trial again with known clocks of its cameras.

    Args:
        trial: The trial.
        clocks: The clocks of its cameras, in their order.

    Returns:
        The trial; its frames are instants on the clock of the first camera.

    Raises:
        FileProblem: A file of the trial cannot be used, or the cameras have no frame in common.
    """
    return _opened(find_layout(trial.folder), trial.settings, clocks=clocks)


def _settings(layout: TrialLayout, changes: Mapping[str, object]) -> TrialSettings:
    """Read trial.toml; what it leaves open is taken from the files of the program that made the folder."""
    settings = read_settings(layout.folder, **changes)
    known = {name: value for name, value in layout.settings.items() if getattr(settings, name) is None}
    try:
        return TrialSettings.model_validate(settings.model_dump() | known)
    except ValidationError as error:
        wrong = f"has a person whose {setting_faults(error)}"
        raise FileProblem(layout.calibration, wrong, "Correct it there, or state it in trial.toml.") from error


def _opened(layout: TrialLayout, settings: TrialSettings, *, free: bool = False, clocks: Clocks | None = None) -> Trial:
    folder = layout.folder
    calibration = calibration_file(stated_calibration(folder, settings.calibration) or layout.calibration)
    rig = read_rig(calibration)
    known = rig.names
    places = video_places(layout, settings.videos or {}, rig.names, calibration)
    if settings.cameras is not None:
        rig = _selected(rig, settings.cameras, calibration)
    from_file = clocks is None and not free and settings.sync != "off"
    clocks = _clocks(folder, rig.names, known) if from_file else clocks
    rate, frames, others = settings.rate, settings.frames, settings.cameras is not None or layout.others
    if free:
        take = open_free_take(folder, rig, rate=rate, others=others, places=places)
    else:
        take = open_take(
            folder, rig, rate=rate, frames=frames, others=others, clocks=clocks, places=places,
            timestamps=settings.sync != "off",
        )  # fmt: skip
        clocks = take.clocks if clocks is None else clocks
    stated = settings.calibration is None and layout.vertical is not None
    up = settings.world.up if settings.world else upward_axis(layout.vertical or 0, rig) if stated else "z"
    world_from_file = z_up_from(up)
    names = _file_names(take)
    given = _given_masks(folder, rig, take, names)
    final = _masks_are_final(folder, rig, given, settings.masks)
    background = _background(folder, rig, settings.background, names)
    if not others:
        room = folder / (settings.background.folder if settings.background else "background")
        _require_known_cameras(room, (*PICTURE_SUFFIXES, *VIDEO_SUFFIXES), names, background)
        _require_known_cameras(folder / "masks", _MASK_SUFFIXES, names, given)
    return Trial(
        folder=folder,
        calibration=calibration,
        rig=rig.moved(world_from_file) if settings.world or stated else rig,
        take=take,
        background=background,
        masks=MappingProxyType(given if final else {}),
        evidence=MappingProxyType({} if final else given),
        network=_network(folder, settings.masks),
        start=_start(folder, settings.start),
        keypoints=_keypoints(folder, settings.keypoints) or layout.keypoints,
        file_names=names,
        follow=_follow(settings.people, rig, range(take.first, take.end)),
        settings=settings,
        world_from_file=world_from_file,
        up_given=settings.world is not None,
        clocks=clocks,
        shutter=shutter_of(folder / "trial.toml", settings, take, known),
        camera_covariance=read_camera_covariance(calibration, rig),
    )


def _file_names(take: Take) -> Mapping[str, tuple[str, ...]]:
    pairs = zip(take.names, take.clips, strict=True)
    return MappingProxyType({name: tuple(dict.fromkeys((name, clip.path.stem))) for name, clip in pairs})


def z_up_from(up: str) -> RigidTransform:
    """Return the rotation that maps an axis of the calibration to the Z axis.

    Args:
        up: The axis that points up.

    Returns:
        The rotation about the origin.
    """
    return RigidTransform(np.array(_Z_UP_FROM[up], float), np.zeros(3))


def _selected(rig: Rig, names: tuple[str, ...], calibration: Path) -> Rig:
    try:
        return rig.subset(names)
    except MareyError as error:
        unknown = ", ".join(f"'{name}'" for name in names if name not in rig.names)
        raise FileProblem(calibration, f"has no camera {unknown}", f"It has {', '.join(rig.names)}.") from error


def _background(
    folder: Path, rig: Rig, table: BackgroundTable | None, file_names: Mapping[str, tuple[str, ...]]
) -> Mapping[str, Clip]:
    """Open the images or clips of the empty room and check their sizes."""
    room = folder / (table.folder if table else "background")
    if not room.is_dir():
        if table:
            raise FileProblem(room, "does not exist", "Correct [background] folder in trial.toml.")
        return MappingProxyType({})
    clips = {}
    for camera in rig:
        found = files_named(room, file_names[camera.name], (*PICTURE_SUFFIXES, *VIDEO_SUFFIXES))
        if len(found) > 1:
            names = ", ".join(path.name for path in found)
            raise FileProblem(room, f"has several images of '{camera.name}': {names}", "Keep one of them.")
        for path in found:
            clips[camera.name] = fitting_clip(open_clip(path), camera.size)
            require_size(clips[camera.name], camera.name, camera.size)
    if not clips:
        wrong = f"has no image of {', '.join(rig.names)}"
        raise FileProblem(room, wrong, f"Name them {rig.names[0]}.png and so on, or remove the folder.")
    return MappingProxyType(clips)


def _clocks(folder: Path, names: Sequence[str], known: Sequence[str]) -> Clocks | None:
    path = folder / CLOCKS_FILE
    return read_clocks(path, names, known=known) if path.exists() else None


_MASK_SUFFIXES = (".npz", ".png", *VIDEO_SUFFIXES)
"""Endings of files with the silhouettes of a camera."""


def _require_known_cameras(
    folder: Path, suffixes: Sequence[str], file_names: Mapping[str, Sequence[str]], found: Mapping[str, object]
) -> None:
    """Check that the files of a folder in which some cameras have none belong to cameras.

    Raises:
        FileProblem: A file has the name of no camera; it is probably that of one without any, misspelled.
    """
    missing = [name for name in file_names if name not in found]
    if not found or not missing:
        return
    known = {name.casefold() for names in file_names.values() for name in names}
    files = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in suffixes or path.is_dir()]
    unknown = [path.name for path in files if (path.name if path.is_dir() else path.stem).casefold() not in known]
    if unknown:
        wrong = f"has {', '.join(unknown)}, which belongs to no camera, and nothing of {', '.join(missing)}"
        raise FileProblem(folder, wrong, "Name the files like the cameras, or remove those that belong to none.")


def _given_masks(folder: Path, rig: Rig, take: Take, file_names: Mapping[str, tuple[str, ...]]) -> dict[str, MaskFile]:
    """Open the given silhouettes by camera."""
    found = {}
    for camera, clip in zip(rig, take.clips, strict=True):
        paths = files_named(folder / "masks", file_names[camera.name], _MASK_SUFFIXES)
        paths += [path for path in [folder / "masks" / camera.name] if path.is_dir()]
        require_no_results(folder, paths)
        if len(paths) > 1:
            names = ", ".join(path.name for path in paths)
            raise FileProblem(folder / "masks", f"has several silhouettes of '{camera.name}': {names}", "Keep one.")
        for path in paths:
            if isinstance(clip, SelectedPictures):
                every = open_masks(path, shape=(clip.clip.count, camera.height, camera.width))
                found[camera.name] = every.selected(clip.pictures)
            else:
                count = clip.count if take.is_free else take.count
                found[camera.name] = open_masks(path, shape=(count, camera.height, camera.width))
    return found


def _masks_are_final(folder: Path, rig: Rig, found: Mapping[str, MaskFile], table: MasksTable | None) -> bool:
    """Return whether given silhouettes are those of the result; they must then be of all cameras."""
    use = None if table is None else table.use
    missing = [name for name in rig.names if name not in found]
    if use is not None and not found:
        wrong = f"has no silhouettes of {', '.join(missing)}, but [masks] use = '{use}' in trial.toml"
        raise FileProblem(folder / "masks", wrong, "Add them, or remove this key.")
    if found and missing and use != "evidence":
        remedy = 'Add them, remove the folder, or set [masks] use = "evidence" in trial.toml.'
        raise FileProblem(folder / "masks", f"has no silhouettes of {', '.join(missing)}", remedy)
    return use != "evidence"


def _network(folder: Path, table: MasksTable | None) -> PersonNetwork | None:
    return None if table is None or table.network is None else open_person_network(folder / table.network)


def _start(folder: Path, table: StartTable | None) -> Path | None:
    if table is None:
        return None
    path = folder / table.file
    if not path.exists():
        raise FileProblem(path, "does not exist", "Correct [start] file in trial.toml.")
    return path


def _follow(table: PeopleTable | None, rig: Rig, frames: range) -> PersonChoice | None:
    if table is None:
        return None
    choice = parse_person(table.follow)
    check_person(choice, rig, frames)
    return choice


def _keypoints(folder: Path, table: KeyPointsTable | None) -> Path | None:
    if table is None:
        return None
    path = folder / table.folder
    if not path.is_dir():
        wrong = "is not a folder" if path.exists() else "does not exist"
        raise FileProblem(path, wrong, "Correct keypoints (--keypoints, or [keypoints] folder in trial.toml).")
    return path
