"""The page of walks beside reference walks: gait profile, parameters, and curves over the cycle."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.io.atomic import replacing
from marey.motion.events.curves import CycleCurves, CycleMark
from marey.motion.events.parameters import QUANTITIES
from marey.motion.events.profile import WHOLE_SCORE, ProfileScore
from marey.motion.events.summaries import GaitSummary
from marey.view.gait.cycle_plots import cycle_plots, number_with_half, stated
from marey.view.pages.curves import COLOURS, CurvesContent, NumberTable, curves_data
from marey.view.pages.html import NO_HEAD, PageHead, rendered
from marey.view.pages.problems import readable
from marey.view.pictures.palette import side_colour
from marey.view.svg.profile_bars import profile_bars

_FILES = {
    "gait_parameters.csv": "the spatio-temporal parameters of each walk, and those of the reference walks",
    "run.json": "version, settings, inputs, timings",
}
"""Files beside the page and their content."""
_PROFILE_FILE = {"gait_profile.csv": "the distances from the reference walks"}
"""The file that is there if there are reference walks."""
_MEANING = {
    "Gait profile score": "Root mean square difference between the joint angles of a walk and the mean of the "
    "reference walks, over the cycle and over the angles of hips, knees, ankles and pelvis (Baker et al. 2009). The "
    "parts by angle are the Movement Analysis Profile. Foot progression, which the paper includes, is no curve here.",
    "Reference walks": "Walks that you measured, of healthy people for instance. Each is compared with the mean of the "
    "others in the same way; median and largest of these scores show what is usual among them. With few references "
    "their mean is itself uncertain, and all scores are somewhat too large.",
    "Rotation of the pelvis": "Relative to its mean over the cycle, because it contains the direction of walking.",
    "95 % interval": "Of the mean over the cycles of a walk: variation between cycles (three or more) and uncertainty "
    "of events and points. The difference of two walks has both intervals combined as independent; placing markers or "
    "fitting the body again adds errors that are constant in each walk and are not part of it.",
}
"""Explanations of the terms on the page."""
_BOTH = "both"
"""The side of quantities that concern both feet."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ShownWalk:
    """A walk on the page."""

    label: str
    curves: CycleCurves
    marks: Sequence[CycleMark]
    """Events in the mean cycle."""
    parameters: Sequence[GaitSummary]
    scores: Sequence[ProfileScore]
    """Distances from the reference walks; none without references."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ShownReferences:
    """The reference walks on the page."""

    count: int
    """Number of walks."""
    bands: Mapping[str, Floats]
    """Mean and standard deviation (101, 2) of each quantity, by its name without side."""
    parameters: Mapping[str, tuple[float, float]]
    """Mean and standard deviation of each spatio-temporal quantity of both sides."""


def write_walks_page(
    path: Path, walks: Sequence[ShownWalk], references: ShownReferences | None, *, notes: Sequence[str],
    settings: Mapping[str, object], timings: Mapping[str, float], head: PageHead = NO_HEAD,
) -> None:  # fmt: skip
    """Write report.html of one or several walks.

    Args:
        path: The file.
        walks: The walks, at least one.
        references: The reference walks; None without any.
        notes: Notes for the reader.
        settings: Settings as in run.json.
        timings: Seconds by stage.
        head: What the head of the page states about the run.
    """
    first = walks[0]
    plots = cycle_plots(
        [(walk.label, walk.curves) for walk in walks], first.marks if len(walks) == 1 else (),
        references=None if references is None else references.bands,
    )  # fmt: skip
    content = CurvesContent(
        kind="Gait", title=", ".join(walk.label for walk in walks), time=np.linspace(0, 100, len(first.curves.mean)),
        head=head, tiles=_tiles(walks, references), notes=notes, tables=_tables(walks, references), groups=[plots],
        timings=timings, settings=settings, files=_FILES if references is None else _PROFILE_FILE | _FILES,
        meaning=_MEANING,
    )  # fmt: skip
    scored = [(walk.label, _colour(walks, k), walk.scores) for k, walk in enumerate(walks) if walk.scores]
    keys = [("left", side_colour("left_")), ("right", side_colour("right_"))]
    if len(walks) > 1:
        keys = [(walk.label, COLOURS[k % len(COLOURS)]) for k, walk in enumerate(walks)]
    html = rendered(
        "walks.html", content, data=curves_data(content, 1), bars=profile_bars(scored) if scored else "", keys=keys
    )
    with replacing(path) as beside:
        beside.write_text(html, encoding="utf-8")


def _colour(walks: Sequence[ShownWalk], k: int) -> str | None:
    """Return the colour of a walk; None if it is the only one, whose bars have the colours of their sides."""
    return COLOURS[k % len(COLOURS)] if len(walks) > 1 else None


def _tiles(walks: Sequence[ShownWalk], references: ShownReferences | None) -> list[tuple[str, str, str]]:
    tiles = []
    for walk in walks:
        score = {entry.side: entry for entry in walk.scores if entry.name == WHOLE_SCORE}.get(_BOTH)
        if score is not None:
            label = f"{WHOLE_SCORE}, {walk.label}" if len(walks) > 1 else WHOLE_SCORE
            usual = f"references: median {score.reference_deg:.1f}°, largest {score.reference_worst_deg:.1f}°"
            tiles.append((label, f"{score.score_deg:.1f}°", usual))
    if references is not None:
        tiles.append(("reference walks", str(references.count), ""))
    for walk in walks:
        speed = next((each for each in walk.parameters if (each.quantity, each.side) == ("speed", _BOTH)), None)
        if speed is not None:
            tiles.append((f"speed, {walk.label}" if len(walks) > 1 else "speed", f"{speed.value:.2f} m/s", ""))
    return tiles


def _tables(walks: Sequence[ShownWalk], references: ShownReferences | None) -> list[NumberTable]:
    tables = [table for table in (_parameter_table(walks, references),) if table.rows]
    if references is not None and any(walk.scores for walk in walks):
        tables.append(_score_table(walks))
    return tables


def _parameter_table(walks: Sequence[ShownWalk], references: ShownReferences | None) -> NumberTable:
    """Return the parameters of all walks: left, right and both, the difference of two walks, and the references."""
    found = [{(each.quantity, each.side): each for each in walk.parameters} for walk in walks]
    rows = []
    for quantity, unit in QUANTITIES.items():
        cells = [stated(own.get((quantity, side))) for own in found for side in ("left", "right", _BOTH)]
        if not any(cells):
            continue
        if len(walks) == 2:
            cells.append(_difference(*(own.get((quantity, _BOTH)) for own in found)))
        if references is not None:
            cells.append(_usual(references.parameters.get(quantity), unit))
        rows.append([f"{readable(quantity)} [{unit}]", *cells])
    named = [f"{walk.label}, " if len(walks) > 1 else "" for walk in walks]
    head = ["quantity", *(f"{name}{side}" for name in named for side in ("left", "right", _BOTH))]
    head += ["second − first"] if len(walks) == 2 else []
    head += ["references"] if references is not None else []
    legend = "Mean over the cycles with its 95 % interval."
    legend += " Second − first: the second walk minus the first, of both sides." if len(walks) == 2 else ""
    legend += " References: mean over the reference walks, with one standard deviation." if references else ""
    return NumberTable(title="Gait parameters", head=head, rows=rows, legend=legend)


def _difference(first: GaitSummary | None, second: GaitSummary | None) -> str:
    """Return the second value minus the first, with half of its 95 % interval."""
    if first is None or second is None:
        return ""
    half = float(np.hypot(first.high - first.value, second.high - second.value))
    return number_with_half(second.value - first.value, half, first.unit)


def _usual(reference: tuple[float, float] | None, unit: str) -> str:
    return "" if reference is None else number_with_half(*reference, unit)


def _score_table(walks: Sequence[ShownWalk]) -> NumberTable:
    found = [{(each.name, each.side): each for each in walk.scores} for walk in walks]
    keys = list(dict.fromkeys(key for own in found for key in own))
    rows = []
    for name, side in keys:
        usual = next(own[name, side] for own in found if (name, side) in own)
        scores = [f"{own[name, side].score_deg:.1f}" if (name, side) in own else "" for own in found]
        rows.append(
            [readable(name), side, *scores, f"{usual.reference_deg:.1f}", f"{usual.reference_worst_deg:.1f}"]
        )  # fmt: skip
    return NumberTable(
        title="Distances from the references",
        head=["angle", "side", *(walk.label for walk in walks), "references: median", "references: largest"], rows=rows,
        legend="Root mean square difference from the mean of the reference walks over the cycle [degrees].",
        text_columns=(0, 1),
    )  # fmt: skip
