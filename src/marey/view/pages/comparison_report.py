"""The report of a comparison: curves of both motions, differences over means, and a table."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from marey.io.results.comparison import SIGNED_KINDS, UNITS
from marey.motion.comparison import ROTATION, WITHOUT_MEAN, Agreement, MotionComparison, worst
from marey.view.pages.curves import (
    COLOURS,
    CurvePlot,
    CurvesContent,
    NumberTable,
    PlotGroup,
    ScatterPlot,
    Trace,
    write_curves_page,
)
from marey.view.pages.html import NO_HEAD, PageHead
from marey.view.pages.problems import readable
from marey.wording import count_of

_FILES = {"compare.csv": "the table of agreement as numbers", "run.json": "version, settings, inputs, timings"}
"""Files beside the report and their content."""
_KINDS = {"angles": "angle", "points": "distance", "orientations": "rotation"}
"""Kind of the rows whose unit all quantities of a kind have."""
_MEANING = {
    "Verdict": "Whether the two motions can be compared: they show the same movement, their clocks are aligned, and "
    "they define the quantities alike. It does not state how large the differences are; the tables do.",
    "Difference": "The first motion minus the second, frame by frame, after the second was transformed to the clock "
    "and the room axes of the first.",
    "Frames compared": "Frames in which both motions have a value of the quantity. Frames of the common time in which "
    "one has none are not compared.",
    "Time shift": "How much later the second clock shows the same instant, estimated with a resolution below one "
    "frame from all quantities that both motions have. Its standard deviation includes differences that persist over "
    "frames, but not differences that resemble a shift, such as the lag of a filter.",
    "Room axes": "The axes of the laboratory or of the calibration in which each system states places. The rotation "
    "and translation that best align the second motion with the first are estimated and removed. A joint centre that "
    "the two systems place differently in the body changes them slightly.",
    "RMS, bias": "Root mean square and mean of the differences. A constant bias of an angle is often a difference in "
    "definition: other segment axes or another zero.",
    "Limits of agreement": "Bias plus and minus 1.96 standard deviations of the differences (Bland and Altman 1986): "
    "95 % of normally distributed differences lie between them. Frames of one trial are not independent, so the limits "
    "describe this trial and not other people.",
    "Correlation": "Pearson correlation over the frames. It measures whether the curves rise and fall together, not "
    "whether they agree, and it grows with the range of motion. That of all quantities of a kind together is one "
    "correlation of all their values about their means: quantities that move more count more, so that it is not the "
    "mean of the correlations in the table of agreement.",
    "Within stated": "Share of the differences within 1.96 standard deviations as stated by the motions; 95 % if the "
    "standard deviations are correct and the definitions are equal. No stated standard deviation contains a difference "
    "of definition.",
    "Orientation": "Angle between the two orientations of a segment, about any axis; without constant offset: after "
    "removal of the mean rotation between the two frames of the segment, which depends on their definitions: a large "
    "angle with the constant offset is no error if the one without it is small.",
}
"""Explanations of the terms on the page."""


def write_comparison_report(
    path: Path, result: MotionComparison, *, names: tuple[str, str], notes: Sequence[str],
    settings: Mapping[str, object], head: PageHead = NO_HEAD,
) -> None:  # fmt: skip
    """Write report.html of a comparison.

    Args:
        path: The file.
        result: The comparison.
        names: Names of the two motions.
        notes: Notes for the reader.
        settings: Settings as in run.json.
        head: What the head of the page states about the run.
    """
    keys = ((names[0], COLOURS[0]), (names[1], COLOURS[1]))
    groups = [
        PlotGroup(title="Angles", plots=_angle_curves(result, keys), keys=keys, legend="Degrees over time [s]."),
        PlotGroup(
            title="Differences of angles", plots=_angle_scatters(result),
            legend="Difference over the mean of both [degrees]; solid line: bias; dashed lines: limits of agreement.",
        ),
        PlotGroup(title="Points", plots=_point_curves(result), legend="Distance between both [mm]."),
    ]  # fmt: skip
    content = CurvesContent(
        kind="Comparison of two motions", title=f"{names[0]} and {names[1]}", time=result.time, tiles=_tiles(result),
        head=head,
        notes=notes, tables=[_together(result), _table(result)], groups=[group for group in groups if group.plots],
        settings=settings, files=_FILES, meaning=_MEANING,
    )  # fmt: skip
    write_curves_page(path, content)


def _tiles(result: MotionComparison) -> list[tuple[str, str, str]]:
    alignment = result.alignment
    span = f"{result.time[-1] - result.time[0]:.2f} s"
    least, most = result.compared_frames
    number = f"{most}" if least == most else f"{least} to {most}"
    both = f"all frames in common, {span}" if least == len(result.time) else f"of {len(result.time)} in common, {span}"
    tiles = [
        ("frames compared", number, both),
        ("time shift", f"{1e3 * alignment.shift_s:.1f} ms", _spread(1e3 * alignment.shift_sd_s, "ms")),
    ]
    if result.clock is not None:
        drift = f"{1e6 * result.clock.drift:.0f} ppm"
        tiles.append(("gain of the first clock over the second", drift, _spread(1e6 * result.clock.drift_sd, "ppm")))
    if result.first.point_names or result.first.segment_names:
        turn = np.degrees(np.linalg.norm(alignment.first_from_second.rotation_vector))
        tiles.append(
            (
                "rotation between room axes",
                f"{turn:.2f}°",
                _spread(float(np.degrees(np.max(alignment.turn_sd))), "°"),
            )
        )
    if result.first.point_names:
        moved = 1e3 * np.linalg.norm(alignment.first_from_second.translation)
        spread = _spread(1e3 * float(np.max(alignment.translation_sd)), "mm")
        tiles.append(("shift between room axes", f"{moved:.0f} mm", spread))
        tiles.append(
            ("distance of points", f"{1e3 * alignment.residual_m:.1f} mm", "root mean square, after alignment")
        )
    angles = next((each for each in result.together if each.kind == "angles"), None)
    if angles is not None:
        largest = worst(result.agreements, "angle")
        below = "" if largest is None else f"; largest: {readable(largest.name)}, {np.degrees(largest.rms):.1f}°"
        below = f"RMS over {count_of(angles.count, 'angle')}{below}"
        tiles.append(("angles differ by", f"{np.degrees(angles.rms):.1f}°", below))
    return tiles


def _spread(sd: float, unit: str) -> str:
    return f"standard deviation {sd:.2g} {unit}" if np.isfinite(sd) else "given, or not determinable"


def _together(result: MotionComparison) -> NumberTable:
    """Return the agreement of all quantities of a kind, on which the verdict is based."""
    rows = []
    for each in result.together:
        unit, scale = UNITS[_KINDS[each.kind]]
        correlation = f"{each.correlation:.2f}".replace("-", "−") if np.isfinite(each.correlation) else ""
        rows.append([f"all {each.kind}", f"{each.count}", f"{scale * each.rms:.2f}", correlation, unit])
    return NumberTable(
        title="All quantities together", head=("kind", "number", "RMS", "correlation", "unit"), rows=rows,
        legend="RMS of points is their distance; that of orientations is without the constant offset of each segment. "
        "The verdict uses these correlations. It states whether the motions can be compared, not how much they differ.",
    )  # fmt: skip


def _table(result: MotionComparison) -> NumberTable:
    return NumberTable(
        title="Agreement",
        head=("quantity", "frames", "RMS", "bias", "limits of agreement", "correlation", "within stated", "unit"),
        rows=[_row(row) for row in result.agreements if row.frames],
        legend="Differences are the first motion minus the second. Orientation: angle between the two orientations of "
        "a segment.",
    )


def _row(row: Agreement) -> list[str]:
    unit, scale = UNITS[row.kind]
    signed = row.kind in SIGNED_KINDS
    low, high = row.limits
    limits = f"{scale * low:+.2f} to {scale * high:+.2f}" if signed else ""
    bias = f"{scale * row.bias:+.2f}" if signed else ""
    cells = [
        _shown_name(row), f"{row.frames}", f"{scale * row.rms:.2f}", bias, limits,
        f"{row.correlation:.3f}" if np.isfinite(row.correlation) and signed else "",
        f"{100 * row.within_stated:.0f} %" if np.isfinite(row.within_stated) else "", unit,
    ]  # fmt: skip
    return [cell.replace("-", "−") for cell in cells]


def _shown_name(row: Agreement) -> str:
    """Return the name of a quantity on the page: rotation means axial rotation elsewhere."""
    if row.kind != "rotation":
        return readable(row.name)
    if row.name.endswith(WITHOUT_MEAN):
        return f"{readable(row.name.removesuffix(WITHOUT_MEAN))} orientation without constant offset"
    return f"{readable(row.name.removesuffix(ROTATION))} orientation"


def _angle_curves(result: MotionComparison, keys: Sequence[tuple[str, str]]) -> list[CurvePlot]:
    pair = (result.first, result.second)
    return [
        CurvePlot(
            title=readable(name),
            curves=[
                Trace(label=label, colour=colour, values=np.degrees(r.angles[:, k]), sd=np.degrees(r.angles_sd[:, k]))
                for (label, colour), r in zip(keys, pair, strict=True)
            ],
        )
        for k, name in enumerate(result.first.angle_names)
    ]


def _angle_scatters(result: MotionComparison) -> list[ScatterPlot]:
    rows = {row.name: row for row in result.agreements if row.kind == "angle"}
    plots = []
    for k, name in enumerate(result.first.angle_names):
        a, b = np.degrees(result.first.angles[:, k]), np.degrees(result.second.angles[:, k])
        low, high = np.degrees(rows[name].limits)
        plots.append(
            ScatterPlot(
                title=readable(name), x=(a + b) / 2, y=a - b, bias=float(np.degrees(rows[name].bias)), low=float(low),
                high=float(high), unit="°",
            )
        )  # fmt: skip
    return plots


def _point_curves(result: MotionComparison) -> list[CurvePlot]:
    apart = 1e3 * np.linalg.norm(result.first.points - result.second.points, axis=-1)
    return [
        CurvePlot(
            title=readable(name), unit=" mm", least=2.0,
            curves=[Trace(label="distance", colour=COLOURS[0], values=apart[:, k])],
        )
        for k, name in enumerate(result.first.point_names)
    ]  # fmt: skip
