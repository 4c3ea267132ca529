"""`marey knee outline`: a page in the browser on which the structures of a volume are outlined by the live wire."""

import gc
import webbrowser
from pathlib import Path

from marey.io.mr.volumes import read_volume
from marey.pipelines.knee.segment import stem
from marey.pipelines.progress import Progress
from marey.view.outline.server import OutlineServer
from marey.view.outline.session import OutlineSession


def outline_server(volume: Path, out: Path | None, port: int, progress: Progress) -> OutlineServer:
    """Read a volume and the outlines it has, and make the server of its page.

    Args:
        volume: What is outlined.
        out: The file of the outlines; `VOLUME_contours.json` beside the volume when None.
        port: 0 for any that is free.
        progress: Is told.

    Raises:
        MareyError: A file cannot be used, or the port is taken.
    """
    path = out or volume.with_name(f"{stem(volume)}_contours.json")
    with progress.stage("Reading"):
        session = OutlineSession(read_volume(volume), path, volume.resolve().name)
    if session.contours:
        progress.report(f"{len(session.contours)} outlines of {path} are gone on with.")
    return OutlineServer(session, port)


def serve(server: OutlineServer, *, browser: bool) -> None:
    """Serve until Ctrl-C."""
    # What the imports made stays. To go through it for garbage takes a tenth of a second, in the midst of a move.
    gc.collect()
    gc.freeze()
    if browser:
        webbrowser.open(server.address)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        pass
    finally:
        server.server_close()
        gc.unfreeze()
