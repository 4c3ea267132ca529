"""Captures with several kinds of evidence at once, beside those with one kind alone.

Three tables. Detected key points alone, that is, the poses that fit the joints without any silhouette; silhouettes
without key points; and both together, without images of the empty room. Then images of the empty room with and without
key points. Then a network that segments people, with nothing else given. The network is
`data/nets/selfie_segmentation.tflite`, which was trained on faces and upper bodies near to a camera.

The truth is rendered; for `balancing` it is key points of another detector, with errors of some centimetres.
"""

import argparse
import json
from pathlib import Path

import numpy as np

import marey
from bench.capture.rooms import TAKES_OF, judged, with_person, without_plate
from bench.common.parts import add_parts, run_parts
from bench.common.program import capture, empty_frames, take, truth_of
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.arrays import Floats
from marey.body.articulation.pose import PosedBody
from marey.pipelines.capture.detected import detected_person
from marey.pipelines.capture.drawn import drawn_from_detections
from marey.pipelines.capture.run import opened
from marey.pipelines.capture.settings import CaptureSettings

BENCH = Bench(
    measures=(
        "Joints with key points, silhouettes and a network alone and together, against rendered truth or key points."
    ),
    sources=(
        "src/marey/cameras",
        "src/marey/images",
        "src/marey/body",
        "src/marey/observations",
        "src/marey/fit",
        "src/marey/io/trial",
        "src/marey/pipelines/capture",
        "src/marey/pipelines/silhouettes",
    ),
    minutes=90,
)

RENDERED = ("jacks", "market", "office")
"""Takes with exact truth of the joints, whose joints alone are scored."""
PLATES = ("walk", "reach", "stealth", "jacks", "balancing")
"""Takes with images of the empty room."""
NETWORK = ("jacks", "market", "office", "walk", "stealth")
"""Takes with nothing but a network. `walk` and `stealth` are held out: nothing was chosen from them."""
LIMB_JOINTS = tuple(
    f"{side}_{name}" for side in "lr" for name in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
)
"""The joints of score/capture.py, by their names in the truth."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)


def run(run: Run) -> None:
    """Capture and score."""
    run_parts(run, PARTS)


def key_points(run: Run) -> None:
    """Compare key points alone, silhouettes alone, and both together."""
    columns = [Column(name, "mm", 1) for name in ("key points alone", "silhouettes alone", "together")]
    holds = Column("95 % intervals of both hold", "", 2)
    table = run.table("Key points and silhouettes, without images of the empty room", "take", *columns, holds)
    for name in RENDERED:
        trial = run.shared / "data" / "people" / name
        bare = without_plate(trial, run.out / "rooms" / "trials" / name)
        alone = joints_alone(trial, bare, run.out / "joints_alone" / name)
        silhouettes, both = (_without_plate(run, name, given) for given in ("nothing", "detected"))
        table.row(name, alone, silhouettes["joint_mm"], both["joint_mm"], both["own_covered_95"])


def plates(run: Run) -> None:
    """Compare captures with images of the empty room with and without key points."""
    columns = [Column("joints", "mm", 1), Column("with key points", "mm", 1), Column("95 % intervals hold", "", 2)]
    table = run.table("Images of the empty room, with key points", "take", *columns)
    for name in PLATES:
        trial, out = take(run, name)
        more = {"keypoints": trial / "keypoints"}
        both = judged(run, trial, capture(trial, run.out / "plates_with_key_points" / name, **more))
        table.row(name, judged(run, trial, out)["joint_mm"], both["joint_mm"], both.get("own_covered_95"))


def network(run: Run) -> None:
    """Compare captures with nothing given with and without a network."""
    columns = [
        Column("joints", "mm", 1),
        Column("IoU", "", 3),
        Column("with the network", "mm", 1),
        Column("IoU with the network", "", 3),
        Column("95 % intervals hold", "", 2),
    ]
    table = run.table("A network, and nothing else given", "take", *columns)
    for name in NETWORK:
        trial = run.shared / "data" / "people" / name
        without = _without_plate(run, name, "nothing")
        bare = without_plate(trial, run.out / "rooms" / "trials" / name)
        net = {"person_net": run.shared / "data" / "nets" / "selfie_segmentation.tflite"}
        numbers = judged(run, trial, capture(bare, run.out / "network" / name, **net, **with_person(trial)))
        figures = [figure[key] for figure in (without, numbers) for key in ("joint_mm", "iou_masks")]
        table.row(name, *figures, numbers.get("own_covered_95"))


PARTS = {"key_points": key_points, "plates": plates, "network": network}
"""The tables by their names."""


def _without_plate(run: Run, name: str, given: str) -> dict:
    """Score a capture of `capture/rooms`."""
    assert name in TAKES_OF[given]
    trial = run.shared / "data" / "people" / name
    bare = without_plate(trial, run.out / "rooms" / "trials" / name)
    more = with_person(trial) | ({"keypoints": bare / "keypoints"} if given == "detected" else {})
    return judged(run, trial, capture(bare, run.out / "rooms" / given / name, **more))


def joints_alone(trial: Path, bare: Path, out: Path) -> float:
    """Return the mean error of the joints [mm] of poses that fit detected key points alone.

    Args:
        trial: The trial with its truth.
        bare: The trial without images of the empty room.
        out: A folder for checkpoints.

    Returns:
        The mean distance of the joints from the truth, over joints and frames with a pose.
    """
    kept = out.with_suffix(".json")
    if not kept.exists():
        truth, empty = np.load(truth_of(trial)), empty_frames(trial)
        frames = range(empty, empty + len(truth["joints"]))
        settings = CaptureSettings(out=out, keypoints=bare / "keypoints", overlay=False)
        own_trial = marey.open_trial(bare, frames=frames, keypoints=settings.keypoints)
        with opened(own_trial, settings, marey.RecordingProgress()) as (own, bodies, _):
            person = detected_person(own)
            assert person is not None
            drawn = drawn_from_detections(own, bodies, person)
        errors = [
            _joint_errors(PosedBody(drawn.body, pose), truth["joints"][frame - empty], truth["joint_names"])
            for frame, pose in drawn.poses.items()
        ]
        kept.write_text(json.dumps(float(np.mean(errors) * 1000)), encoding="utf-8")
    return json.loads(kept.read_text(encoding="utf-8"))


def _joint_errors(posed: PosedBody, joints: Floats, names: Floats) -> Floats:
    """Return the distances (12,) of the limb joint centres from the truth [m]."""
    body, known = posed.body, [str(name) for name in names]
    centres = posed.segment_origin[body.joint_segments]
    own = [body.joint_names.index(name.replace("l_", "left_").replace("r_", "right_")) for name in LIMB_JOINTS]
    return np.linalg.norm(centres[own] - joints[[known.index(name) for name in LIMB_JOINTS]], axis=1)
