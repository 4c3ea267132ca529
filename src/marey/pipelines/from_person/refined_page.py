"""The page of cameras that were refined by a person: their changes, and whether to use them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from marey.cameras.camera import Camera
from marey.cameras.parameters import PARAMETERS
from marey.fit.cameras.refine import RefinedCameras
from marey.pipelines.cameras.knocked import displacement, displacement_sd
from marey.pipelines.from_person.camera_changes import CameraChanges
from marey.view.pages.curves import CurvesContent, NumberTable, write_curves_page
from marey.view.pages.html import PageHead, files_beside

FILES = {
    "cameras.toml": "the refined cameras, as marey capture, Pose2Sim and Anipose read them",
    "calibration.json": "covariances of the cameras, findings",
    "run.json": "version, settings, inputs, timings",
}
"""Files beside the page and their content."""
_MEANING = {
    "Changes": "How far the person turns and shifts each camera from its given pose. Position, orientation and scale "
    "of the cameras as a whole are kept, since no person determines them, and so are the lenses.",
    "Standard deviation": "From the covariance of the joint adjustment of cameras, motion and body, of all directions "
    "together. It does not include an error that all silhouettes share.",
    "Probability": "Of changes as large as these, of all cameras together, if the given cameras are right. Below "
    "0.1 % the person contradicts the given cameras. It is too small for a person who hardly moves, since the misfits "
    "of body and silhouettes are then alike in all frames.",
}
"""Explanations of the terms on the page."""
_LEGEND = "± are standard deviations. The decision is about all cameras together: their errors depend on each other."
"""Legend of the table of changes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RefinedPage:
    """Content of the page."""

    title: str
    before: Sequence[Camera]
    """The given cameras."""
    refined: RefinedCameras
    changes: CameraChanges | None
    """Their changes together; None if the take does not determine all of them."""
    head: PageHead
    notes: Sequence[str] = ()
    settings: Mapping[str, object] = field(default_factory=dict)
    timings: Mapping[str, float] = field(default_factory=dict)


def write_refined_page(path: Path, page: RefinedPage) -> None:
    """Write the page.

    Args:
        path: The HTML file; the other results of the run are beside it.
        page: The content.
    """
    content = CurvesContent(
        kind="Cameras refined by a person", title=page.title, time=np.zeros(1), tiles=_tiles(page), notes=page.notes,
        tables=[_table(page)], settings=page.settings, timings=page.timings, meaning=_MEANING, head=page.head,
        files=files_beside(FILES, [each.name for each in path.parent.iterdir()]),
    )  # fmt: skip
    write_curves_page(path, content)


def _tiles(page: RefinedPage) -> list[tuple[str, str, str]]:
    cameras = page.refined.cameras
    moved = [displacement(old, new) for old, new in zip(page.before, cameras, strict=True)]
    tiles = [
        ("cameras", f"{len(cameras)}", ", ".join(camera.name for camera in cameras)),
        ("turned", f"{max(turn for turn, _ in moved):.2f} °", "largest of the cameras"),
        ("shifted", f"{max(shift for _, shift in moved):.0f} mm", "largest of the cameras"),
    ]
    if page.changes is None:
        return tiles
    use = "new" if page.changes.significant else "given"
    return [("cameras to use", use, f"probability of such changes by chance: {page.changes.chance}"), *tiles]


def _table(page: RefinedPage) -> NumberTable:
    rows = []
    for c, (old, new) in enumerate(zip(page.before, page.refined.cameras, strict=True)):
        own = slice(PARAMETERS * c, PARAMETERS * (c + 1))
        (turn, shift), (turn_sd, shift_sd) = (
            displacement(old, new), displacement_sd(new, page.refined.covariance[own, own]),
        )  # fmt: skip
        known = "no" if new.name in page.refined.undetermined else "yes"
        rows.append((new.name, f"{turn:.2f}", f"{turn_sd:.2f}", f"{shift:.0f}", f"{shift_sd:.0f}", known))
    head = ("camera", "turned °", "± °", "shifted mm", "± mm", "determined by the take")
    return NumberTable(title="Changes of the cameras", head=head, rows=rows, text_columns=(0, 5), legend=_LEGEND)
