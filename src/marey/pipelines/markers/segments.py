"""Segments of a marker trial: from a TOML, or from the labels."""

from marey.errors import FileProblem, MareyError, SettingProblem
from marey.io.markers.trial_file import MarkerFile
from marey.markers.data.labels import FoundClusters, clusters_from_names, find_clusters
from marey.markers.data.setup import MarkerSetup
from marey.pipelines.markers.settings import MarkerSettings

_MOST_LABELS = 12
"""Number of labels that an error message lists; more would hide the rest of the message. Chosen by hand."""


def segments_of(file: MarkerFile, setup: MarkerSetup, settings: MarkerSettings) -> FoundClusters:
    """Find the segments that the TOML names, or those that the labels indicate.

    Args:
        file: The trial.
        setup: The content of the TOML.
        settings: Name the TOML.

    Raises:
        FileProblem: There is no segment, or one of the TOML has too few markers.
        SettingProblem: The TOML describes the skin of a segment that the trial does not have.
    """
    found = _found_segments(file, setup, settings)
    there = [cluster.segment for cluster in found.clusters]
    unknown = sorted(set(setup.skin) - set(there))
    if unknown:
        raise SettingProblem(
            f"[skin] names the unknown segment {', '.join(unknown)}; the segments are: {', '.join(there)}."
        )
    return found


def _found_segments(file: MarkerFile, setup: MarkerSetup, settings: MarkerSettings) -> FoundClusters:
    labels = file.trajectories.labels
    if setup.segments:
        try:
            return clusters_from_names(setup.segments, labels)
        except MareyError as problem:
            wrong = f"does not fit {file.path.name} ({str(problem).rstrip('.')})"
            raise FileProblem(settings.clusters or file.path, wrong) from problem
    found = find_clusters(labels)
    if not found.clusters:
        some = ", ".join(labels[:_MOST_LABELS]) + (", ..." if len(labels) > _MOST_LABELS else "")
        raise FileProblem(
            file.path,
            f"has no three labels that differ only by a number, so its segments are unknown; its labels are {some}",
            'Name the segments in a TOML, [segments] thigh = ["label", ...], and give it as clusters (--clusters).',
        )  # fmt: skip
    return found
