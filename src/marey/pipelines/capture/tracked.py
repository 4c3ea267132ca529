"""A person tracked through a take, and the checkpoints of its poses."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from marey.body.articulation.pose import Pose, packed_poses, unpacked_poses
from marey.body.articulation.surface import Body
from marey.body.metaballs.metaball_person import reshaped
from marey.fit.recipes.person import SilhouetteTake, shape_frames
from marey.fit.recipes.sequence import FrameTermsFactory, RefineCheckpoint
from marey.fit.search.search import Candidate
from marey.io.stages import Arrays
from marey.pipelines.capture.kept_candidates import KeptArrays
from marey.pipelines.capture.mask_store import MaskStore
from marey.pipelines.capture.run import Run


@dataclass(frozen=True, eq=False)
class Tracked:
    """A person tracked through a take: the body, and one pose per frame."""

    body: Body
    poses: Mapping[int, Pose]
    scores: Mapping[int, float]


@dataclass(frozen=True, eq=False)
class FollowedPerson:
    """A person tracked through the take, and the silhouettes with the person as prior."""

    tracked: Tracked
    filled: Mapping[int, Pose]
    """Interpolated poses of frames between others with a pose."""
    outlines: MaskStore
    frames: Sequence[int]
    """Frames that show a person."""
    terms: FrameTermsFactory | None = None
    """Further observations for the refinement."""
    repaired: bool = True
    """Whether single frames are repaired by searching for limbs in the silhouettes; they must show the whole person."""

    def take(self, run: Run) -> SilhouetteTake:
        """Return the take as the refinement needs it."""
        poses, store = self.tracked.poses, self.outlines
        return SilhouetteTake(tuple(run.trial.rig), store, tuple(poses), run.trial.take.rate, store.edges, store.hidden)


def frames_for_sizes(run: Run, scores: Mapping[int, float]) -> list[int]:
    """Return the frames from which the sizes of the body are estimated; none if they are fixed."""
    return [] if run.settings.fixed_sizes else shape_frames(scores, run.person.shape_frames)


@contextmanager
def rounds_of(run: Run, name: str) -> Iterator[RefineCheckpoint]:
    """Open the checkpoints of a refinement: finished rounds, and finished windows of the present round."""
    with (
        run.cache.frames(f"{name}_rounds", depends=run.scope) as rounds,
        run.cache.frames(f"{name}_windows", depends=run.scope) as windows,
    ):
        yield RefineCheckpoint(KeptArrays(rounds), KeptArrays(windows))


def pack_candidates(found: Mapping[int, Candidate], body: Body) -> Arrays:
    """Return candidates by frame, and the shape parameters of their body, as arrays."""
    return pack_tracked({f: c.posed.pose for f, c in found.items()}, body, {f: c.score for f, c in found.items()})


def pack_tracked(poses: Mapping[int, Pose], body: Body, scores: Mapping[int, float]) -> Arrays:
    """Return poses and scores by frame, and the shape parameters of the body, as arrays."""
    return {
        "frames": np.array(list(poses)),
        **packed_poses(poses.values()),
        "score": np.array([scores[frame] for frame in poses]),
        "numbers": np.array(body.numbers),
    }


def unpack_tracked(arrays: Arrays, body: Body) -> Tracked:
    """Return the tracked person from its arrays; the body is another one of the same shape parameters."""
    frames = [int(frame) for frame in arrays["frames"]]
    return Tracked(
        reshaped(body, arrays["numbers"]),
        dict(zip(frames, unpacked_poses(arrays), strict=True)),
        dict(zip(frames, map(float, arrays["score"]), strict=True)),
    )
