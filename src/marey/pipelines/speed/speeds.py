"""`marey bench`: the speed of the main steps, compared with another program in the same run or with a limit."""

import os
import platform
import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy.optimize

from marey.arrays import Floats, Image, Mask
from marey.body.articulation.pose import Pose, PosedBody, SkinPoints
from marey.body.people.person import family_body
from marey.cameras.camera import Camera
from marey.extras import install_advice
from marey.fit.solver.moments import Moments, gather_moments
from marey.fit.solver.pose_solver import solve_pose
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.images.silhouettes.background import from_pictures
from marey.images.silhouettes.silhouettes import segment
from marey.io.calibration.readers import read_rig
from marey.io.video.take import open_take
from marey.io.video.video import read_picture
from marey.knee.outlines.live_wire import LiveWire
from marey.observations.correspondence import view_of
from marey.observations.silhouette import SilhouettePlanes
from marey.pipelines.capture.settings import CaptureSettings
from marey.pipelines.progress import Progress
from marey.pipelines.speed.surface_speed import SIDE, SPACING, SURFACE_LIMIT_S, surface_seconds

CORRESPONDENCES = 5000
"""Number of correspondences from which a pose is solved in the measurement. Chosen by hand."""
SOLVE_LIMIT_MS = 1.0
"""Limit for the solution of a pose [ms]. Set by hand as what counts as fast enough."""
LEVEL_SET_LIMIT_MS = 10.0
"""Limit for the silhouette of an image [ms]. Set by hand as what counts as fast enough."""
FRAMES_LIMIT_HZ = 8.0
"""Limit for the rate of a whole capture [frames/s]. Set by hand as what counts as fast enough."""
WIRE_LIMIT_MS = 50.0
"""Limit of the time of the first response of the live wire [ms]. Chosen by hand as fast enough."""
WIRE_SIDE = 512
"""Width and height of the slice in which the live wire is timed [px]."""
AFTER_POSE = ("Comparison", "Results", "Overlays", "Report")
"""Stages of a capture after the poses are known: they only write results."""
_SEED = 20060101
"""Seed of the random numbers of the measurements."""


@dataclass(frozen=True, kw_only=True)
class Speed:
    """One row of the table."""

    what: str
    measured: str
    beside: str
    """The limit, or the other program in the same run."""
    remark: str = ""


def measure_speeds(trial: Path | None, *, example: Path | None = None, progress: Progress) -> list[Speed]:
    """Measure the speeds; in a process that is set as by `marey.process.tuned_process`.

    Args:
        trial: A trial that is captured as a whole, to time all steps from video to pose; None skips it.
        example: The take on whose images the silhouettes are timed; None skips it.
        progress: Progress reporter of the capture.

    Returns:
        One entry per measurement.

    Raises:
        FileProblem: The trial cannot be captured.
    """
    if trial is not None:
        from marey.io.trial.trial import read_trial

        read_trial(trial)  # a fault of the trial is reported before the other measurements, which take minutes
    speeds = [*solve_speeds(), drawing_speed(), wire_speed()]
    if example is not None:
        speeds += [*silhouette_speeds(example), surface_speed()]
    if trial is not None:
        speeds += capture_speeds(trial, progress)
    return speeds


def machine() -> str:
    """Return the name of the machine: processor, cores, Python and NumPy."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        models = [
            line.split(":", 1)[1].strip()
            for line in info.read_text(encoding="utf-8").splitlines()
            if "model name" in line
        ]
        name = models[0] if models else name
    return f"{name}, {os.cpu_count()} cores, Python {platform.python_version()}, NumPy {np.__version__}"


def median_ms(work: Callable[[], object], *, repeats: int) -> float:
    """Measure the processor time of a function [ms]: the median of some repeats, after one that compiles.

    Processor time instead of wall-clock time is used so that other work on the same machine has little influence.
    """
    work()
    times = []
    for _ in range(repeats):
        started = time.process_time()
        work()
        times.append(time.process_time() - started)
    return 1e3 * statistics.median(times)


@dataclass(frozen=True, eq=False)
class SolveTask:
    """A pose that is to be found from pairs of surface point and contour tangent, as in tracking."""

    start: PosedBody
    truth: Pose
    planes: SilhouettePlanes

    def solve(self) -> Pose:
        """Solve with moments and Gauss-Newton; a copy of the planes has to be scaled to pixels again."""
        return self.steps(gather_moments(self.start, [replace(self.planes)]))

    def steps(self, moments: Moments) -> Pose:
        """Do only the Gauss-Newton steps, until one is shorter than the limit of tracking."""
        return solve_pose(self.start, moments, [], steps=50)[0].pose

    def peer(self) -> Pose:
        """Solve with `scipy.optimize.least_squares` (MINPACK), given the exact derivative."""

        def derivative(change: Floats) -> Floats:
            jacobian = self.planes.linearize(self.start.moved(change)).jacobian
            # The root is rotated by exp(change) from the start, not by a small step from its present orientation.
            jacobian[:, 3:6] = jacobian[:, 3:6] @ rotations.left_jacobian(change[3:6])
            return jacobian

        zero = np.zeros(len(self.start.body.skeleton))
        answer = scipy.optimize.least_squares(
            lambda change: self.planes.residuals(self.start.moved(change)).ravel(), zero, derivative, method="lm"
        )
        return self.start.pose.step(answer.x)


def solve_task(rng: np.random.Generator, count: int = CORRESPONDENCES) -> SolveTask:
    """Make a task: contour tangents of four cameras, 2 mm noise, and a start 14 degrees off in every joint.

    Args:
        rng: Random numbers.
        count: Number of tangents, the correspondences.
    """
    body = family_body("fine")
    angles = body.skeleton.habit[0] + rng.normal(size=len(body.skeleton) - 6) * 0.2
    truth = Pose(np.array([0.1, 0.2, 1.0]), rotations.exp(rng.normal(size=3)), angles)
    where = SkinPoints(
        face=rng.integers(0, len(body.faces), count),
        barycentric=rng.dirichlet([1.0, 1.0, 1.0], count),
    )
    targets = PosedBody(body, truth).points(where) + rng.normal(size=(count, 3)) * 0.002
    centres = np.array([[4.0, 0, 1], [0, 4, 1], [-4, 0, 1], [0, -4, 1]])[rng.integers(0, 4, count)]
    contour = rng.normal(size=(count, 3))
    normals = np.cross(targets - centres, contour)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    planes = SilhouettePlanes(
        where=where, normals=normals, offsets=np.einsum("na,na->n", normals, targets),
        pixels_per_metre=np.full(count, 200.0), sigma_px=1.0,
    )  # fmt: skip
    off = rng.normal(size=len(body.skeleton))
    off *= np.concatenate([np.full(3, 0.05), np.full(3, 0.1), np.full(len(off) - 6, np.deg2rad(14))])
    return SolveTask(PosedBody(body, truth.step(off)), truth, planes)


def solve_speeds() -> list[Speed]:
    """Time the solution of a pose by marey and by SciPy, from the same start to the same pose."""
    task = solve_task(np.random.default_rng(_SEED))
    ours, theirs = task.solve(), task.peer()
    apart = float(np.rad2deg(np.abs(ours.angles - theirs.angles).max()))
    own_ms, peer_ms = median_ms(task.solve, repeats=30), median_ms(task.peer, repeats=3)
    moments = gather_moments(task.start, [task.planes])
    steps_ms = median_ms(lambda: task.steps(moments), repeats=30)
    what = f"pose from {CORRESPONDENCES} correspondences, {len(task.start.body.skeleton)} degrees of freedom"
    same = f"poses {apart:.1e} degrees apart"
    return [
        Speed(what=what, measured=f"{own_ms:.2f} ms", beside=f"limit {SOLVE_LIMIT_MS:g} ms",
              remark=f"moments {own_ms - steps_ms:.2f} ms, all steps {steps_ms:.2f} ms"),
        Speed(
            what="the same by scipy.optimize.least_squares", measured=f"{peer_ms:.0f} ms",
            beside=f"{peer_ms / own_ms:.0f} times marey", remark=f"lm, exact derivative; {same}",
        ),
    ]  # fmt: skip


def drawing_speed() -> Speed:
    """Time the drawing of the body and of its rim in one camera of 640 x 480 pixels."""
    body = family_body("fine")
    posed = PosedBody(body, Pose(np.array([0.0, 0, 0]), np.eye(3), body.skeleton.habit[0]))
    rotation = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    camera = Camera(
        name="cam01", size=(640, 480), matrix=np.array([[820.0, 0, 320], [0, 820, 240], [0, 0, 1]]),
        distortion=np.zeros(4), camera_from_world=RigidTransform(rotation, np.array([0, 0, 4.2])),
    )  # fmt: skip
    spent = median_ms(lambda: view_of(posed, camera).rim(body.faces), repeats=50)
    return Speed(
        what=f"surface of {len(body.faces)} faces and its rim in a camera", measured=f"{spent:.2f} ms", beside=""
    )


def silhouette_speeds(example: Path) -> list[Speed]:
    """Time the silhouettes of one camera by marey and by the level set of scikit-image, on the same images."""
    rig = read_rig(example / "cameras.toml").subset(["cam01"])
    take = open_take(example, rig, others=True)
    plate = from_pictures([read_picture(example / "background" / "cam01.png")])
    pictures = [images[0] for _, images in take.at(range(40, 60))]
    first = segment(pictures[0], plate)

    def follow() -> None:
        last = first
        for picture in pictures[1:]:
            last = segment(picture, plate, start=last.mask, before=last)

    own_ms = median_ms(follow, repeats=3) / (len(pictures) - 1)
    limit = f"limit {LEVEL_SET_LIMIT_MS:g} ms"
    own = Speed(what="silhouette of a 640x480 view after the first", measured=f"{own_ms:.1f} ms", beside=limit)
    peer = _peer_level_set(pictures[1], first.mask)
    if peer is None:
        missing = Speed(what="the same by scikit-image", measured="-", beside="", remark=install_advice("bench"))
        return [own, missing]
    peer_ms = median_ms(peer, repeats=1)
    beside = f"{peer_ms / own_ms:.0f} times marey"
    remark = "morphological_chan_vese, 10 iterations from the same start, grey, no background"
    return [own, Speed(what="the same by scikit-image", measured=f"{peer_ms:.0f} ms", beside=beside, remark=remark)]


def surface_speed() -> Speed:
    """Time the dense measurement of a surface."""
    seconds, count = surface_seconds()
    return Speed(what=f"surface, {SIDE}x{SIDE} triplet every {SPACING} px", measured=f"{seconds:.1f} s",
                 beside=f"limit {SURFACE_LIMIT_S:g} s", remark=f"{count} points, all cores")  # fmt: skip


def wire_speed() -> Speed:
    """Time the slowest response of the live wire: from a new anchor in one corner of a slice to the opposite corner."""
    row, column = np.mgrid[:WIRE_SIDE, :WIRE_SIDE]
    disc = 60.0 * (np.hypot(row - WIRE_SIDE / 2, column - WIRE_SIDE / 2) < WIRE_SIDE / 3)
    wire = LiveWire(disc + np.random.default_rng(_SEED).normal(0, 10, disc.shape), (0.3, 0.3))

    def move() -> None:
        wire.forget()
        wire.anchor((0, 0))
        wire.path_to((WIRE_SIDE, WIRE_SIDE))

    return Speed(what=f"live wire's first move across a slice of {WIRE_SIDE}x{WIRE_SIDE}",
                 measured=f"{median_ms(move, repeats=15):.2f} ms", beside=f"limit {WIRE_LIMIT_MS:g} ms")  # fmt: skip


def _peer_level_set(picture: Image, start: Mask) -> Callable[[], object] | None:
    try:
        from skimage.segmentation import morphological_chan_vese
    except ImportError:
        return None
    grey = picture.mean(2)
    return lambda: morphological_chan_vese(grey, num_iter=10, init_level_set=start.astype(np.int8))


def capture_speeds(trial: Path, progress: Progress) -> list[Speed]:
    """Capture a trial without overlays; return frames per second without the start, and the memory."""
    from marey.io.trial.trial import read_trial
    from marey.pipelines.capture.capture import capture_trial

    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        settings = CaptureSettings(out=Path(folder) / "marey", overlay=False)
        frames = len(capture_trial(read_trial(trial), settings, progress))
    whole = time.perf_counter() - begun
    start, after = (sum(progress.timings.get(name, 0.0) for name in names) for names in (["Start"], AFTER_POSE))
    to_pose = sum(progress.timings.values()) - start - after
    # Linux counts in kB, macOS in bytes.
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << 20 if sys.platform == "darwin" else 1 << 10)
    stages = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in progress.timings.items())
    return [
        Speed(what=f"{trial.name}: from video to final pose, without start and overlays",
              measured=f"{frames / to_pose:.1f} frames/s", beside=f"limit {FRAMES_LIMIT_HZ:g} frames/s",
              remark=stages),
        Speed(what="the same with files and start of the program", measured=f"{frames / (whole - start):.1f} frames/s",
              beside=""),
        Speed(what="start", measured=f"{start:.1f} s", beside="limit 45 s"),
        Speed(what="peak memory", measured=f"{peak_mb:.0f} MB", beside="limit 2000 MB"),
    ]  # fmt: skip
