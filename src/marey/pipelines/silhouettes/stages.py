"""The stages of a capture that process the videos frame by frame: backgrounds and silhouettes."""

from collections import deque
from collections.abc import Callable, Container, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from marey.arrays import Floats, Image, Integers, Mask
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.presets import follows_limb
from marey.body.articulation.surface import Body
from marey.cameras.camera import Camera
from marey.errors import FileProblem
from marey.fit.consistency.cut_outlines import cut_cameras
from marey.fit.consistency.tangents import Outline, differences_px
from marey.fit.search.hull import common_parts
from marey.fit.solver.picture_times import PictureTimes
from marey.fit.solver.threads import usable_threads
from marey.images.features.part_borders import part_borders
from marey.images.features.part_evidence import part_evidence
from marey.images.silhouettes.background import (
    Background,
    updated_from_frame,
)
from marey.images.silhouettes.interior import InteriorEdges, find_edges
from marey.images.silhouettes.occluders import divided
from marey.images.silhouettes.other_person import TwoColours
from marey.images.silhouettes.part_colours import PartColours, hidden_region, joined_hidden
from marey.images.silhouettes.silhouettes import Silhouette, segment, shape_term
from marey.io.trial.trial import Trial
from marey.observations.correspondence import view_of
from marey.pipelines.occlusion.occluders import Occluders
from marey.pipelines.people.other_regions import OtherRegions
from marey.pipelines.progress import Progress
from marey.pipelines.silhouettes.empty_rooms import resized
from marey.pipelines.silhouettes.mask_store import MaskStore
from marey.pipelines.verdict import NotUsable, Verdict, VerdictReason
from marey.view.pages.problems import frames_text

UPDATE_INTERVAL = 10
"""Number of images after which an uncertain background is updated where the body is not.

Chosen by hand; results were not measured against other values.
"""
PULL, PULL_REACH = 0.5, 8.0
"""Prior of the silhouette from the predicted body: log-likelihood per pixel of distance [1/px], and the distance up to
which it grows [px].

Chosen by hand. Without this prior the overlap of the silhouettes of `jacks` falls from 0.948 to 0.917
(docs/accuracy/rejected.md); other values were not measured.
"""
CLUTTER_FRAMES, LEAST_COMMON = 8, 0.85
"""Number of frames that are checked for clutter, and the share of the silhouettes that the cameras have in common
without clutter.

Chosen by hand: `tpose`, with clutter, has no start without this check, and all other takes have 95 % and more in
common.
"""


def find_silhouettes(
    trial: Trial,
    views: "Sequence[SilhouetteState]",
    cameras: Sequence[Camera],
    store: MaskStore,
    progress: Progress,
    *,
    name: str,
    predicted: "Callable[[int], Sequence[Expected] | None]" = lambda frame: None,
    earlier: "EarlierSilhouettes | None" = None,
) -> None:
    """Find the silhouettes of all frames that are not in the store yet, and edges inside them at predicted rims.

    Args:
        trial: The trial; its take is read once, in order.
        views: The state of each camera before the first frame.
        cameras: Cameras of the size at which the images are processed.
        store: Receives the silhouettes.
        progress: Progress reporter.
        name: Name of the stage.
        predicted: Returns the predicted body of a frame for each camera; None if it is not known.
        earlier: Silhouettes that are kept in some frames, whose images are not read.
    """
    take = trial.take
    done = len(store.frames)
    last = [_known(view) for view in views]
    waiting: deque[tuple[int, list[Future[SilhouetteState]]]] = deque()
    kept = frozenset[int]() if earlier is None else earlier.frames

    def keep_until(frame: int, step: Callable[[], None]) -> None:
        while earlier is not None and store.frames.stop < frame:
            store.keep(earlier.store)
            step()

    def finish(step: Callable[[], None]) -> None:
        frame, futures = waiting.popleft()
        seen = [future.result() for future in futures]
        keep_until(frame, step)
        store.append(
            [view.mask for view in seen],
            [view.edges for view in seen if view.edges is not None],
            [view.hidden for view in seen if view.hidden is not None],
            [view.energy for view in seen],
        )
        step()

    with (
        progress.stage(name, take.end - take.first, done=done) as step,
        ThreadPoolExecutor(max_workers=usable_threads()) as pool,
    ):
        for frame, images in take.at([each for each in range(take.first + done, take.end) if each not in kept]):
            starts: Sequence[Expected | None] = predicted(frame) or [None] * len(last)
            # The next image of a camera depends on its last one only, not on the other cameras.
            last = [pool.submit(_update_next, *each) for each in zip(last, images, cameras, starts, strict=True)]
            waiting.append((frame, last))
            if len(waiting) > 2:
                finish(step)
        while waiting:
            finish(step)
        keep_until(take.end, step)


@dataclass(frozen=True, eq=False)
class EarlierSilhouettes:
    """Silhouettes of an earlier round, and the frames in which they are kept."""

    store: MaskStore
    frames: frozenset[int]


def _known(view: "SilhouetteState") -> "Future[SilhouetteState]":
    future: Future[SilhouetteState] = Future()
    future.set_result(view)
    return future


def _update_next(
    last: "Future[SilhouetteState]", image: Image, camera: Camera, expected: "Expected | None"
) -> "SilhouetteState":
    return update_silhouette(last.result(), resized(image, camera), expected)


@dataclass(frozen=True, eq=False)
class Expected:
    """The predicted body in one camera."""

    mask: Mask
    """(height, width) of the full image."""
    rims: InteriorEdges
    """Rims of limbs in front of others, in an image of `camera`."""
    camera: Camera
    """Camera of an image that is large enough to find the rims."""
    pull: Floats | None = None
    """(height, width) prior of the silhouette; by default that of `pull_of`."""
    parts: Integers | None = None
    """(height, width) part of the body at each pixel, -1 outside; None if the parts' colours are not used."""
    elsewhere: bool = False
    """Whether a detector found only other people in the image: what it shows here may be theirs, so that no outline of
    the silhouette is used."""
    slack: float = 0.0
    """Depth inside the body from which on a pixel that the silhouette lacks is hidden [px]."""
    others: OtherRegions | None = None
    """Where other people are; None if nothing is known of any."""
    behind: Mask | None = None
    """(height, width) where a thing of the room stands in front of the body; None if nothing is known of any."""


@dataclass(frozen=True, eq=False)
class SilhouetteState:
    """State of the silhouettes of one camera after some images of a take."""

    background: Background
    before: Silhouette | None = None
    """The last silhouette that was not empty."""
    mask: Mask = field(default_factory=lambda: np.zeros((0, 0), bool))
    """The silhouette of the last image."""
    edges: InteriorEdges | None = None
    """The edges inside it; None without a prediction."""
    hidden: Mask | None = None
    """Where something hides the person; None if the parts' colours are not known."""
    colours: PartColours | None = None
    """Colours of the parts of the body in this camera; None if they are not known."""
    pictures: int = 0
    """Number of images so far."""
    two_colours: TwoColours | None = None
    """Colours of the followed person and of other people in this camera; None if they are not known."""
    energy: float = 0.0
    """Energy of the last silhouette [nat], see `Silhouette`."""


def update_silhouette(view: SilhouetteState, image: Image, expected: Expected | None) -> SilhouetteState:
    """Find the silhouette in the next image of a camera; a predicted body is a prior of its silhouette.

    If the colours of the body's parts are known, nothing is found in an image in which no body is predicted. Where
    other people may be, the image gives no evidence; where they are in front, the silhouette ends.
    """
    start = None if expected is None or not expected.mask.any() else expected.mask
    if view.colours is not None and start is None:
        nothing = np.zeros(image.shape[:2], bool)
        empty = replace(view, mask=nothing, hidden=nothing, edges=InteriorEdges.none(), energy=0.0)
        return replace(empty, pictures=view.pictures + 1)
    prior = None if expected is None or start is None else (pull_of(start) if expected.pull is None else expected.pull)
    others = None if expected is None or start is None else expected.others
    if others is not None and start is not None and view.two_colours is not None:
        others = others.refined(image, view.two_colours, start)
    if prior is not None and view.two_colours is not None:
        prior = prior - np.maximum(view.two_colours.ratio(image), 0)
    ignored = None if others is None else others.near
    behind = None if expected is None else expected.behind
    if behind is not None and view.colours is not None:
        ignored = behind if ignored is None else ignored | behind
    local = None
    if view.colours is not None and expected is not None and expected.parts is not None:
        local = part_evidence(image, expected.parts, view.colours, expected.slack)
    found = segment(image, view.background, start=start, before=view.before, prior=prior, ignored=ignored, local=local)
    hidden = None
    if view.colours is not None and expected is not None and expected.parts is not None:
        hidden = hidden_region(image, expected.parts, view.colours)
        hidden = joined_hidden(hidden, expected.mask, found.mask, expected.slack)
        found = replace(found, mask=found.mask & ~hidden)
        hidden = hidden | expected.elsewhere
    if others is not None:
        found = replace(found, mask=found.mask & ~others.front)
        hidden = others.near if hidden is None else hidden | others.near
    if behind is not None:
        # Where the image is no evidence, it does not show what is seen in front of the thing either.
        mask, more = divided(found.mask, behind) if view.colours is None else (found.mask & ~behind, behind)
        found = replace(found, mask=mask)
        hidden = more if hidden is None else hidden | more
    background = view.background
    if start is not None and view.colours is None and view.pictures % UPDATE_INTERVAL == 0:
        reach = max(image.shape[:2]) // 16
        near = cv2.dilate((start | found.mask).astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
        background = updated_from_frame(background, image, found.exposure, near)
    before = found if found.mask.any() else view.before
    edges = None if expected is None else look_inside(image, found, expected, view.colours)
    return SilhouetteState(
        background, before, found.mask, edges, hidden=hidden, colours=view.colours, pictures=view.pictures + 1,
        two_colours=view.two_colours, energy=found.energy,
    )  # fmt: skip


def look_inside(
    image: Image, found: Silhouette, expected: Expected, colours: PartColours | None = None
) -> InteriorEdges:
    """Find the edges of limbs inside a silhouette near the predicted ones [px of the full image].

    If the colours of the parts are known, borders between parts of different colours are edges, too.
    """
    camera, mask, parts = expected.camera, found.mask, expected.parts
    if (mask.shape[1], mask.shape[0]) != camera.size:
        mask = cv2.resize(mask.view(np.uint8), camera.size, interpolation=cv2.INTER_NEAREST).view(bool)
    small, borders = resized(image, camera), None
    if colours is not None and parts is not None:
        if (parts.shape[1], parts.shape[0]) != camera.size:
            parts = cv2.resize(parts.astype(np.int16), camera.size, interpolation=cv2.INTER_NEAREST).astype(np.int64)
        borders = part_borders(small, mask, expected.rims, parts, colours)
    edges = find_edges(small, mask, expected.rims, found.exposure.noise, borders=borders)
    return edges.scaled(image.shape[1] / camera.width)


def pull_of(start: Mask) -> Floats:
    """Return the prior of a predicted silhouette, [Rosenhahn2006] eq. (4); it is computed near the body."""
    margin = int(PULL_REACH) + 2
    rows, columns = np.flatnonzero(start.any(1)), np.flatnonzero(start.any(0))
    part = (
        slice(max(rows[0] - margin, 0), rows[-1] + margin + 1),
        slice(max(columns[0] - margin, 0), columns[-1] + margin + 1),
    )
    pull = np.full(start.shape, -PULL * PULL_REACH, np.float32)
    pull[part] = shape_term(start[part], PULL, PULL_REACH)
    return pull


def known_silhouettes(trial: Trial, store: MaskStore, progress: Progress) -> None:
    """Read the silhouettes that the user gave.

    Args:
        trial: The trial.
        store: Receives the silhouettes.
        progress: Progress reporter.

    Raises:
        FileProblem: A camera has none.
    """
    take = trial.take
    missing = [name for name in trial.rig.names if name not in trial.masks]
    if missing:
        wrong = f"has silhouettes of some cameras but none of {', '.join(missing)}"
        raise FileProblem(trial.folder / "masks", wrong, "Add those of all cameras in use, or remove the folder.")
    files = [trial.masks[name] for name in trial.rig.names]
    wanted = range(take.first + len(store.frames), take.end)
    with progress.stage("Silhouettes", take.end - take.first, done=len(store.frames)) as step:
        for masks in zip(*(file.masks(wanted) for file in files), strict=True):
            store.append(masks)
            step()


def frames_with_somebody(store: MaskStore) -> tuple[int, ...]:
    """Return the frames in which at least two cameras see a person."""
    return tuple(frame for frame in store.frames if sum(bool(mask.any()) for mask in store(frame)) >= 2)


def cut_in(store: MaskStore, cameras: Sequence[Camera], frames: Sequence[int]) -> tuple[int, ...]:
    """Return the numbers of the cameras in which something hides a part of the person, see `cut_cameras`."""
    sample = [store(frame) for frame in _sample(frames)]
    outlines = [[Outline.of(masks[c], camera) for masks in sample] for c, camera in enumerate(cameras)]
    return cut_cameras(differences_px(cameras, outlines))


def _sample(frames: Sequence[int]) -> list[int]:
    return [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, min(CLUTTER_FRAMES, len(frames))).astype(int))]


def cluttered(
    store: MaskStore, cameras: Sequence[Camera], frames: Sequence[int], progress: Progress, cut: Sequence[int] = ()
) -> bool:
    """Return whether the cameras have too little of their silhouettes in common, and warn of those that differ.

    What some cameras lack because something hides it there, `cut`, does not count.
    """
    sample = _sample(frames)
    shares = np.full((len(sample), len(cameras)), np.nan)
    for f, frame in enumerate(sample):
        masks = store(frame)
        for c, (kept, mask) in enumerate(zip(common_parts(cameras, masks, cut=cut), masks, strict=True)):
            if mask.any():
                shares[f, c] = np.count_nonzero(kept) / np.count_nonzero(mask)
    if np.median(np.nanmean(shares, 1)) >= LEAST_COMMON:
        return False
    usual = np.nanmean(shares, 0)
    bad = [camera.name for camera, share in zip(cameras, usual, strict=True) if share < LEAST_COMMON]
    progress.warn(
        f"Much of the foreground in {', '.join(bad)} is not seen by the other cameras: only the part that all cameras "
        "have in common is used. Do the images of the empty room belong to this recording?"
    )
    return True


def common_silhouettes(
    store: MaskStore, cameras: Sequence[Camera], common: MaskStore, progress: Progress, cut: Sequence[int] = ()
) -> MaskStore:
    """Write the parts of the silhouettes that the cameras have in common to a store, and return it; see `cluttered`."""
    with progress.stage("Common silhouettes", len(store.frames), done=len(common.frames)) as step:
        for frame in store.frames[len(common.frames) :]:
            common.append(common_parts(cameras, store(frame), cut=cut))
            step()
    return common


def require_somebody(trial: Trial, frames: Sequence[int]) -> None:
    """Check that a person was detected.

    Raises:
        NotUsable: No person was detected.
    """
    if not frames:
        what = f"{trial.folder} shows no person that at least two cameras see at the same time."
        remedy = (
            "Check that the images of the empty room belong to this recording, and that a person moves in the videos."
        )
        raise NotUsable(Verdict.of([VerdictReason.failure(what, remedy, cause="nobody")]))


def warn_of_lost(progress: Progress, frames: Sequence[int], found: Container[int], *, count: int) -> None:
    """Warn of frames that show a person whose pose was not found."""
    lost = np.zeros(count, bool)
    lost[[frame for frame in frames if frame not in found]] = True
    if lost.any():
        progress.warn(f"The person is visible but was lost in {frames_text(lost)}: these frames have no pose.")


def expectations(
    body: Body, poses: Mapping[int, Pose], cameras: Sequence[Camera], small: Sequence[Camera],
    times: PictureTimes | None = None, occluders: Occluders | None = None,
) -> Callable[[int], Sequence[Expected] | None]:
    """Return a function that predicts the body in every camera; it returns None for frames without a pose.

    Args:
        body: The person's body.
        poses: Poses by frame.
        cameras: Cameras of the full images.
        small: Cameras of images that are just large enough to find the rims of the limbs.
        times: When the cameras have taken their pictures; None if that is at the instants of the frames.
        occluders: What stands in front of the person; None if nothing is known of it.
    """

    def expected(frame: int) -> Sequence[Expected] | None:
        if frame not in poses:
            return None
        posed = PosedBody(body, poses[frame])
        late = [posed] * len(cameras) if times is None else times.posed(frame, posed, poses)
        drawn = [expected_of(*each) for each in zip(late, cameras, small, strict=True)]
        if occluders is None or not occluders.any:
            return drawn
        behind = occluders.behind(late, cameras)
        return [replace(each, behind=hidden) for each, hidden in zip(drawn, behind, strict=True)]

    return expected


def expected_of(posed: PosedBody, camera: Camera, small: Camera) -> Expected:
    """Draw the predicted body, and find the rims of its limbs in a smaller image."""
    view = view_of(posed, camera)
    inner = view if small.size == camera.size else view_of(posed, small)
    rim = inner.interior_rim(posed.body.faces, posed.body.face_limb)
    rims = InteriorEdges(pixels=rim.pixels, inward=rim.inward, limb=posed.body.face_limb[rim.face])
    return Expected(view.mask(), rims, small)


LEAST_UPRIGHT = 0.5
"""Cosine of the angle between trunk and Z below which a person counts as lying.

Chosen by hand: bending forward and sitting stay above it.
"""


def require_upright(trial: Trial, posed: PosedBody) -> None:
    """Check that Z points up, unless the user has named the axis that does.

    The body of a single limb says nothing about it: in silhouettes of a whole person its trunk and limb may be fitted
    to any part of the outline, and the trunk beside a limb that fills the images may be inclined in any way.

    Raises:
        NotUsable: The person lies or hangs head down.
    """
    if follows_limb(trial.settings.preset):
        return
    names = posed.body.skeleton.segment_names
    at = {name: posed.segment_origin[k] for k, name in enumerate(names)}
    trunk = at["neck"] - 0.5 * (at["left_thigh"] + at["right_thigh"])
    trunk = trunk / np.linalg.norm(trunk)
    if trial.up_given or trunk[2] >= LEAST_UPRIGHT:
        return
    axis = int(np.argmax(np.abs(trunk)))
    guess = ("" if trunk[axis] > 0 else "-") + "xyz"[axis]
    how = "hangs head down" if trunk[2] < -LEAST_UPRIGHT else "lies"
    what = f"{trial.calibration} has a world in which the person {how}: Z should point up."
    remedy = (
        f'Set [world] up = "{guess}" in trial.toml if that axis points up, or up = "z" if the person does lie or hang.'
    )
    raise NotUsable(Verdict.of([VerdictReason.failure(what, remedy, cause="vertical axis")]))
