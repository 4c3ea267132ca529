"""What the tests of calibration share."""

import pytest
from tests.pipelines.calibrate.board_pictures import CalibratedSession, calibrated


@pytest.fixture(scope="session")
def calibrated_session(tmp_path_factory: pytest.TempPathFactory) -> CalibratedSession:
    return calibrated(tmp_path_factory.mktemp("calibrated"))
