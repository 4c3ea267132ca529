import threading
import urllib.request
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from marey.cli.main import run
from marey.io.mr.volumes import write_volume
from marey.knee.space.volume import Volume, VoxelGrid
from marey.pipelines.knee.outline import outline_server, serve
from marey.pipelines.progress import RecordingProgress

if find_spec("SimpleITK") is None:
    pytest.skip("SimpleITK is not installed", allow_module_level=True)

GRID = VoxelGrid(shape=(8, 20, 24), lps_from_voxel=np.diag([-1.0, -1.0, 3.0, 1.0]))


@pytest.mark.slow
def test_a_volume_is_served_and_its_outlines_are_kept_beside_it(tmp_path: Path):
    volume = tmp_path / "knee.nii.gz"
    write_volume(volume, Volume(intensity=np.random.default_rng(1).normal(20.0, size=GRID.shape), grid=GRID))
    server = outline_server(volume, None, 0, RecordingProgress())
    assert server.session.path == tmp_path / "knee_contours.json"
    thread = threading.Thread(target=serve, args=(server,))
    thread.start()
    try:
        with urllib.request.urlopen(server.address, timeout=20) as page:
            assert b"knee.nii.gz" in page.read()
    finally:
        server.shutdown()
        thread.join()
    assert not server.session.path.exists()


def test_what_is_no_volume_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert run(["knee", "outline", str(tmp_path / "nothing.nii.gz")]) == 2
    assert "does not exist" in capsys.readouterr().err
