"""Gadolinium markers on the skin of a knee: found in each volume, and combined."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from marey.io.mr import gadolinium
from marey.io.mr.gadolinium import MarkersInScanner
from marey.knee.markers.gadolinium import find_gadolinium, joined
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.volume import Volume
from marey.pipelines.progress import Progress


def earlier_markers(out: Path) -> MarkersInScanner | None:
    """Read the markers of an earlier run, to which names may have been added by hand; None if there are none.

    Args:
        out: The folder of the results.

    Raises:
        FileProblem: The file is damaged; names that were added by hand would be lost.
    """
    path = out / gadolinium.FILE
    return gadolinium.read_markers(path) if path.exists() else None


def markers_in(
    volumes: Sequence[Volume],
    surfaces: Mapping[str, TriangleSurface],
    earlier: MarkersInScanner | None,
    progress: Progress,
) -> MarkersInScanner | None:
    """Find the markers on the skin.

    Args:
        volumes: The images.
        surfaces: Surfaces of the bones by name.
        earlier: Markers of an earlier run; names and bones of markers in the same places are kept.
        progress: Progress reporter.

    Returns:
        The markers; None if there are none.
    """
    with progress.stage("Markers", len(volumes)) as step:
        each = []
        for volume in volumes:
            each.append(find_gadolinium(volume, surfaces))
            step()
    found = each[0] if len(each) == 1 else joined(*each)
    for note in found.notes:
        progress.warn(note)
    if not len(found):
        progress.report("No gadolinium marker was found on the skin.")
        return None
    size = f"median diameter {np.median(found.diameter_mm):.1f} mm"
    progress.report(f"{len(found)} gadolinium marker{'s' if len(found) > 1 else ''} on the skin, {size}.")
    markers = MarkersInScanner.of(found)
    return markers if earlier is None else markers.named_as(earlier)
