"""Outlining of the structures of a volume with the live wire, on a page in the browser."""

from contextlib import suppress
from pathlib import Path

from marey.io.mr.volumes import read_volume
from marey.pipelines.knee.segment import stem
from marey.pipelines.progress import Progress, RecordingProgress
from marey.view.outline.server import OutlineServer
from marey.view.outline.session import OutlineSession


def outline_server(
    volume: Path, out: Path | None = None, port: int = 0, progress: Progress | None = None
) -> OutlineServer:
    """Read a volume and its outlines, and make the server of the page.

    Args:
        volume: A file, or a folder with a DICOM series.
        out: The file of the outlines; by default `VOLUME_contours.json` beside the volume.
        port: Port of the page's address; 0 for any free one.
        progress: Progress reporter.

    Raises:
        MareyError: A file cannot be used, or the port is in use.
    """
    progress = progress or RecordingProgress()
    path = out or volume.with_name(f"{stem(volume)}_contours.json")
    with progress.stage("Reading"):
        session = OutlineSession(read_volume(volume), path, volume.resolve().name)
    if session.contours:
        progress.report(f"{len(session.contours)} outlines were read from {path}.")
    return OutlineServer(session, port)


def serve(server: OutlineServer) -> None:
    """Serve the page until it is shut down, or interrupted with Ctrl-C.

    Args:
        server: The server; it is closed at the end.
    """
    try:
        with suppress(KeyboardInterrupt):
            server.serve_forever()
    finally:
        server.server_close()
