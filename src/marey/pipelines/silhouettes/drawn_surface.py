"""The skin of a fitted body as the cameras see it: masks, rims, and agreement with the silhouettes."""

from collections.abc import Callable, Collection, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from marey.arrays import Floats, Integers, Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.cameras import lens
from marey.cameras.camera import Camera
from marey.cameras.visibility import View, see
from marey.fit.solver.picture_times import PictureTimes
from marey.fit.solver.threads import map_in_threads
from marey.io.trial.masks import mask_writer
from marey.io.trial.trial import Trial
from marey.pipelines.occlusion.occluders import Occluders
from marey.pipelines.silhouettes.mask_store import MaskStore

PackedMask = NDArray[np.uint8]
"""Boolean values, eight per byte, as `numpy.packbits` packs them."""


@dataclass(frozen=True, eq=False)
class PosedSkin:
    """The skin in every frame with a pose."""

    faces: Integers
    """(T, 3) indices of vertices."""
    vertices_of: Callable[[int], Floats]
    """Returns the posed vertices (V, 3) of a frame [m, world]."""
    late_vertices: Callable[[int, int], Floats] | None = None
    """Returns those at the instant of a camera's picture, from the frame and the camera's number; None if all pictures
    are taken at the instants of the frames."""

    @staticmethod
    def of(body: Body, poses: Mapping[int, Pose], times: PictureTimes | None = None) -> "PosedSkin":
        """Return the body's own skin, with the times at which the cameras have taken their pictures."""

        def late(frame: int, camera: int) -> Floats:
            assert times is not None
            return times.posed(frame, PosedBody(body, poses[frame]), poses)[camera].vertices

        at_frames = PosedSkin(body.faces, lambda frame: PosedBody(body, poses[frame]).vertices)
        return at_frames if times is None else replace(at_frames, late_vertices=late)

    def seen_by(self, camera: Camera, frame: int, number: int) -> View:
        """Draw the skin as a camera of a number sees it in its picture."""
        posed = self.vertices_of(frame) if self.late_vertices is None else self.late_vertices(frame, number)
        vertices = np.ascontiguousarray(posed)
        projected = np.empty_like(vertices)
        lens.project_points(camera.packed, vertices, projected)
        return see(projected, self.faces, camera.size)


@dataclass(frozen=True)
class HiddenShare:
    """How much something hides the person in one camera."""

    person: float
    """Mean share of the drawn surface that is hidden, from 0 to 1."""
    image: float
    """Share of the image in which a thing of the room stands in front of the person, from 0 to 1."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinInImages:
    """The skin of a take as it appears in the images, beside the silhouettes."""

    agreement: Mapping[int, Floats]
    """Agreement of surface and silhouettes by frame: intersection over union (C,), NaN if both are empty. Where
    something hides the person, pixels do not count."""
    hidden: Mapping[str, HiddenShare]
    """How much something hides the person, by camera; empty if it is hidden nowhere."""
    vertex_count: int
    """Number V of vertices of the skin."""
    packed_rims: Mapping[int, PackedMask]
    """By frame, which vertices (V,) are on the rim of the surface in some camera."""

    def seen_vertices(self, count: int) -> Iterator[Mask]:
        """Yield for each of a number of frames which vertices (V,) are on a rim, and so were measured."""
        nothing = np.zeros(self.vertex_count, bool)
        for frame in range(count):
            rim = self.packed_rims.get(frame)
            yield nothing if rim is None else np.unpackbits(rim, count=self.vertex_count).astype(bool)


@dataclass(frozen=True, eq=False)
class _DrawnFrame:
    """The skin in one frame."""

    masks: list[Mask]
    """One mask (height, width) per camera."""
    rim: Mask
    """(V,) true for vertices on the rim in some camera."""

    @staticmethod
    def of(skin: PosedSkin, cameras: Sequence[Camera], frame: int) -> "_DrawnFrame":
        """Draw the skin in all cameras."""
        views = [skin.seen_by(camera, frame, c) for c, camera in enumerate(cameras)]
        return _DrawnFrame([view.mask() for view in views], _vertices_on_rims(views, skin.faces))


def draw_skin(
    skin: PosedSkin, frames: Container[int], trial: Trial, store: MaskStore, *, folder: Path,
    occluders: Occluders | None = None, done: Callable[[], None] = lambda: None,
) -> SkinInImages:  # fmt: skip
    """Draw the skin in every camera and frame once, write `surface_masks/`, and compare it with the silhouettes.

    Args:
        skin: The skin.
        frames: The frames with a pose.
        trial: The trial.
        store: The silhouettes, with the regions in which something hides the person.
        folder: The folder of the results.
        occluders: The things of the room in front of the person; None if nothing is known of any.
        done: Called after each frame with a pose.

    Returns:
        The comparison, and the rims of the surface.
    """
    cameras, count = list(trial.rig), trial.take.count
    agreement: dict[int, Floats] = {}
    rims: dict[int, PackedMask] = {}
    shares: list[list[float]] = []
    known = [frame for frame in range(count) if frame in frames]
    drawn = zip(known, map_in_threads(lambda frame: _DrawnFrame.of(skin, cameras, frame), known), strict=True)
    with _mask_writers(folder / "surface_masks", trial) as append:
        for frame, own in drawn:
            append(frame, own.masks)
            hidden = store.hidden(frame)
            agreement[frame] = _agreement(own.masks, store(frame), hidden)
            rims[frame] = np.packbits(own.rim)
            if hidden is not None:
                shares.append([_hidden_share(*pair) for pair in zip(own.masks, hidden, strict=True)])
            done()
    return SkinInImages(
        agreement=agreement, hidden=_hidden_shares(shares, len(known), occluders, trial.rig.names),
        vertex_count=vertices_in(skin, known), packed_rims=rims,
    )  # fmt: skip


def _vertices_on_rims(views: Sequence[View], faces: Integers) -> Mask:
    """Return which vertices (V,) are on the rim of the surface in some view."""
    found = np.zeros(len(views[0].projected), bool)
    for view in views:
        found[faces[view.rim(faces).face]] = True
    return found


def _agreement(surfaces: Sequence[Mask], masks: Sequence[Mask], hidden: Sequence[Mask] | None) -> Floats:
    """Return the agreement (C,) of surface and silhouettes of a frame."""
    if hidden is not None:
        surfaces = [surface & ~behind for surface, behind in zip(surfaces, hidden, strict=True)]
        masks = [mask & ~behind for mask, behind in zip(masks, hidden, strict=True)]
    return np.array([_overlap(a, b) for a, b in zip(surfaces, masks, strict=True)])


def _overlap(a: Mask, b: Mask) -> float:
    union = int(np.count_nonzero(a | b))
    return int(np.count_nonzero(a & b)) / union if union else float("nan")


def _hidden_share(surface: Mask, behind: Mask) -> float:
    return int(np.count_nonzero(surface & behind)) / max(int(np.count_nonzero(surface)), 1)


def _hidden_shares(
    shares: Sequence[Sequence[float]], frames: int, occluders: Occluders | None, names: Sequence[str]
) -> dict[str, HiddenShare]:
    """Return the means of the hidden shares of frames, by camera; nothing if the person is hidden nowhere."""
    person = np.sum(shares, axis=0) / frames if shares else np.zeros(len(names))
    if not person.any():
        return {}
    image = [0.0] * len(names) if occluders is None else [thing.share for thing in occluders.things]
    return {name: HiddenShare(float(a), b) for name, a, b in zip(names, person, image, strict=True)}


def write_silhouettes(folder: Path, trial: Trial, store: MaskStore) -> None:
    """Write the silhouettes of the images to `masks/`, one file per camera."""
    with _mask_writers(folder / "masks", trial) as append:
        for frame in store.frames:
            append(frame, store(frame))


@contextmanager
def _mask_writers(folder: Path, trial: Trial) -> Iterator[Callable[[int, Sequence[Mask]], None]]:
    """Open one file of silhouettes per camera; yield a function that takes a frame and its masks, in ascending order.

    The masks of all other frames of the video are empty.
    """
    count, following = trial.take.count, 0
    with ExitStack() as files:
        appends = [
            files.enter_context(
                mask_writer(folder / f"{camera.name}.npz", shape=(count, camera.height, camera.width))
            )
            for camera in trial.rig
        ]  # fmt: skip

        def append(frame: int, masks: Sequence[Mask]) -> None:
            nonlocal following
            for write, mask in zip(appends, masks, strict=True):
                for _ in range(following, frame):
                    write(None)
                write(mask)
            following = frame + 1

        yield append


def skins(skin: PosedSkin, frames: Collection[int], count: int) -> Iterator[Floats]:
    """Yield the posed skin (V, 3) of every frame; NaN without a pose."""
    nowhere = np.full((vertices_in(skin, frames), 3), np.nan)
    for frame in range(count):
        yield skin.vertices_of(frame) if frame in frames else nowhere


def vertices_in(skin: PosedSkin, frames: Iterable[int]) -> int:
    """Return the number of vertices of the skin."""
    return len(skin.vertices_of(next(iter(frames))))


def on_rim(skin: PosedSkin, frame: int, cameras: Sequence[Camera]) -> Mask:
    """Return which vertices (V,) are on the rim of the surface in some camera."""
    return _vertices_on_rims([skin.seen_by(camera, frame, c) for c, camera in enumerate(cameras)], skin.faces)
