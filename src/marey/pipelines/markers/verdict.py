"""The verdict on the motion of bones: faults of the markers, frames without a pose, and the fit of a model."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from marey.markers.data.trajectories import MarkerTrajectories
from marey.markers.kinematics.joint_angles import joint_of
from marey.pipelines.causes.bone_axes import axis_reasons, unmeasured_reasons
from marey.pipelines.causes.marker_model import lying_reasons, model_reasons
from marey.pipelines.markers.estimated_bones import MethodRun
from marey.pipelines.markers.model_trial import ModelTrial
from marey.pipelines.markers.trial import ClusterTrial, MarkerTrial
from marey.pipelines.verdict import Verdict, VerdictReason
from marey.wording import listed

MOST_MODEL_RMS_M = 0.02
"""Root mean square distance between markers and model above which it is named [m]: the limit of [Hicks2015]."""
NO_MODEL_RMS_M = 0.1
"""The same distance above which the model is not that of the person [m]: about the radius of a thigh. Chosen by
hand."""

_UNDETERMINED = (
    "Give frames in which every segment shows at least three markers (--frames, --fill), and check that each label "
    "names a marker of its segment (--clusters)."
)
"""What to do where the markers do not determine the motion."""
_SCALED = "Check that the model was scaled to this person, and that each label is on the marker of the model."
"""Remedy for a distance between markers and model that nothing explains."""


def bones_verdict(trial: MarkerTrial, run: MethodRun) -> Verdict:
    """Return the verdict on the motion of bones.

    Args:
        trial: The trial.
        run: The result of the first method, which the files contain.
    """
    reasons = _of_trial(trial)
    faults = trial.faults if isinstance(trial, ClusterTrial) else ()
    reasons += [*_poses(trial, run, faults), *_assumed(run)]
    if not trial.anatomical:
        what = "The poses of the bones are not known: the angles are rotations since the reference frame."
        remedy = "For anatomical angles add --reference, or --static with landmarks."
        reasons.append(VerdictReason.limit(what, remedy))
    elif isinstance(trial, ClusterTrial) and not trial.wrong_units:
        joints = [joint_of(*pair, side=trial.side) for pair in trial.problem.joints]
        reasons += [*axis_reasons(run.motion, run.joints, joints), *unmeasured_reasons(run.joints, joints)]
    return Verdict.of([*reasons, *(_model(trial, run) if isinstance(trial, ModelTrial) else ())])


def failed_verdict(trial: MarkerTrial, problem: str) -> Verdict:
    """Return the verdict on a trial whose markers do not determine the motion of the bones.

    Args:
        trial: The trial.
        problem: Why they do not, as a sentence.
    """
    what = f"{trial.path.name}: {problem.rstrip('.')}."
    return Verdict.of([*_of_trial(trial), VerdictReason.failure(what, _UNDETERMINED, cause="undetermined")])


def _of_trial(trial: MarkerTrial) -> list[VerdictReason]:
    """Return what is wrong with the markers themselves."""
    if not isinstance(trial, ClusterTrial):
        return []
    reasons = list(trial.reasons)
    reasons += [
        VerdictReason.failure(text, "Correct the unit (--unit, or in the reference).") for text in trial.wrong_units
    ]
    return reasons + [VerdictReason.limit(text) for text in trial.faults if text not in trial.wrong_units]


def _poses(trial: MarkerTrial, run: MethodRun, faults: tuple[str, ...]) -> Iterator[VerdictReason]:
    """Name the bones without a pose in some frames, unless a fault of their markers explains it."""
    frames = trial.selection.frames
    answered, count = run.motion.answered[frames].sum(0), int(frames.sum())
    remedy = "Fill the gaps of the trial (--fill), or give other markers of the segment."
    if not answered.any():
        yield VerdictReason.failure("No frame has a pose of any bone.", remedy)
        return
    for name, number in zip(run.motion.segments, answered, strict=True):
        if number < count and not any(fault.startswith(f"{name}:") for fault in faults):
            yield VerdictReason.limit(f"{name}: {count - number} of {count} frames have no pose.", remedy)


def _assumed(run: MethodRun) -> Iterator[VerdictReason]:
    """Name the widths of joints that nothing on the person shows, and what they contribute to the angles."""
    rows = [row for row in run.offsets if row.measurement.of_others]
    if not rows:
        return
    names = listed(dict.fromkeys(row.measurement.name.replace("_", " ") for row in rows))
    worst = max(rows, key=lambda row: row.sd)
    yield VerdictReason.limit(
        f"Means of other people are used for {names}: a constant standard deviation of up to "
        f"{np.degrees(worst.sd):.1f} degrees ({worst.angle.replace('_', ' ')}), which is part of the intervals.",
        "Measure the widths and give them (--measurements, or [person] in the TOML), or use medial markers "
        "in the static trial.",
        cause="assumed widths",
    )


def _model(trial: ModelTrial, run: MethodRun) -> Iterator[VerdictReason]:
    """Judge the fit of an OpenSim model."""
    if run.undetermined:
        what = f"The markers do not determine {listed(run.undetermined, most=8)}."
        yield VerdictReason.limit(what, "These coordinates keep the value of a task, a limit or the model.")
    if "pelvis" in run.motion.segments:
        yield from lying_reasons(run.motion.bone("pelvis")[0], y_up=trial.file.y_up)
    if np.isfinite(run.model_rms_m) and run.model_rms_m > MOST_MODEL_RMS_M:
        causes = model_reasons(trial.model, _chosen(trial), y_up=trial.file.y_up)
        yield from causes
        what = f"The markers lie {1e3 * run.model_rms_m:.0f} mm (RMS) from the model; at most 20 mm are usual."
        remedy = "" if causes else f"No unit, mirror image or exchange of labels explains it. {_SCALED}"
        make = VerdictReason.failure if run.model_rms_m > NO_MODEL_RMS_M else VerdictReason.limit
        yield make(what, remedy)


def _chosen(trial: ModelTrial) -> MarkerTrajectories:
    """Return the markers of the requested frames in which one is visible."""
    used = trial.selection.used
    seen = trial.selection.frames & used.present.any(1)
    return replace(used, points=used.points[seen], filled=used.filled[seen], residuals=used.residuals[seen])
