"""The skin of a fitted body as the cameras see it: masks, rims, and agreement with the silhouettes."""

from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from marey.arrays import Floats, Integers, Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.cameras import lens
from marey.cameras.camera import Camera
from marey.cameras.visibility import View, see
from marey.fit.solver.picture_times import PictureTimes
from marey.io.trial.masks import write_masks
from marey.io.trial.trial import Trial
from marey.pipelines.occlusion.occluders import Occluders
from marey.pipelines.silhouettes.mask_store import MaskStore


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


def surface_masks(
    skin: PosedSkin, frames: Container[int], cameras: Sequence[Camera]
) -> Callable[[int], Sequence[Mask] | None]:
    """Return a function that draws the silhouette of the skin in every camera; it returns None without a pose."""

    def drawn(frame: int) -> Sequence[Mask] | None:
        if frame not in frames:
            return None
        return [skin.seen_by(camera, frame, c).mask() for c, camera in enumerate(cameras)]

    return drawn


def agreements(
    drawn: Callable[[int], Sequence[Mask] | None], frames: Iterable[int], store: MaskStore, *, done: Callable[[], None]
) -> dict[int, Floats]:
    """Return the agreement of surface and silhouettes by frame: intersection over union (C,), NaN if both are empty.

    Where something hides the person, pixels do not count.
    """
    found = {}
    for frame in frames:
        masks, surfaces, hidden = store(frame), drawn(frame) or [], store.hidden(frame)
        if hidden is not None:
            surfaces = [surface & ~behind for surface, behind in zip(surfaces, hidden, strict=True)]
            masks = [mask & ~behind for mask, behind in zip(masks, hidden, strict=True)]
        found[frame] = np.array([_overlap(a, b) for a, b in zip(surfaces, masks, strict=True)])
        done()
    return found


@dataclass(frozen=True)
class HiddenShare:
    """How much something hides the person in one camera."""

    person: float
    """Mean share of the drawn surface that is hidden, from 0 to 1."""
    image: float
    """Share of the image in which a thing of the room stands in front of the person, from 0 to 1."""


def hidden_shares(
    drawn: Callable[[int], Sequence[Mask] | None], frames: Sequence[int], store: MaskStore, occluders: Occluders | None,
    names: Sequence[str],
) -> dict[str, HiddenShare]:  # fmt: skip
    """Return how much something hides the person, by camera; nothing if it is hidden nowhere.

    Args:
        drawn: Returns the drawn surface of a frame, one mask (height, width) per camera.
        frames: The frames with a pose.
        store: The silhouettes, with the regions in which something hides the person.
        occluders: The things of the room in front of the person; None if nothing is known of any.
        names: Names of the cameras.
    """
    shares = []
    for frame in frames:
        hidden, surfaces = store.hidden(frame), drawn(frame)
        if hidden is not None and surfaces is not None:
            shares.append([
                int(np.count_nonzero(surface & behind)) / max(int(np.count_nonzero(surface)), 1)
                for surface, behind in zip(surfaces, hidden, strict=True)
            ])  # fmt: skip
    person = np.sum(shares, axis=0) / len(frames) if shares else np.zeros(len(names))
    if not person.any():
        return {}
    image = [0.0] * len(names) if occluders is None else [thing.share for thing in occluders.things]
    return {name: HiddenShare(float(a), b) for name, a, b in zip(names, person, image, strict=True)}


def _overlap(a: Mask, b: Mask) -> float:
    union = int(np.count_nonzero(a | b))
    return int(np.count_nonzero(a & b)) / union if union else float("nan")


def write_all_masks(
    folder: Path, trial: Trial, store: MaskStore, drawn: Callable[[int], Sequence[Mask] | None]
) -> None:
    """Write the silhouettes of the images and of the fitted surface, one file per camera."""
    count = trial.take.count
    for kind, masks_of in (("masks", store.known), ("surface_masks", drawn)):
        (folder / kind).mkdir()
        for c, camera in enumerate(trial.rig):
            every = (masks_of(frame) for frame in range(count))
            own = (None if masks is None else masks[c] for masks in every)
            write_masks(folder / kind / f"{camera.name}.npz", own, shape=(count, camera.height, camera.width))


def skins(skin: PosedSkin, frames: Sequence[int], count: int) -> Iterator[Floats]:
    """Yield the posed skin (V, 3) of every frame; NaN without a pose."""
    nowhere = np.full((vertices_in(skin, frames), 3), np.nan)
    for frame in range(count):
        yield skin.vertices_of(frame) if frame in frames else nowhere


def vertices_in(skin: PosedSkin, frames: Iterable[int]) -> int:
    """Return the number of vertices of the skin."""
    return len(skin.vertices_of(next(iter(frames))))


def seen_vertices(skin: PosedSkin, frames: Sequence[int], cameras: Sequence[Camera], count: int) -> Iterator[Mask]:
    """Yield for every frame which vertices (V,) are on the rim of the surface in some camera, and so were measured."""
    nothing = np.zeros(vertices_in(skin, frames), bool)
    for frame in range(count):
        yield on_rim(skin, frame, cameras) if frame in frames else nothing


def on_rim(skin: PosedSkin, frame: int, cameras: Sequence[Camera]) -> Mask:
    """Return which vertices (V,) are on the rim of the surface in some camera."""
    seen = np.zeros(len(skin.vertices_of(frame)), bool)
    for c, camera in enumerate(cameras):
        rim = skin.seen_by(camera, frame, c).rim(skin.faces)
        seen[skin.faces[rim.face]] = True
    return seen
