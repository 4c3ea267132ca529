"""The result of a calibration: cameras with covariances, errors, and what was found in the session."""

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from marey.arrays import Floats
from marey.cameras.rig import Rig
from marey.io.calibration.toml import read_toml
from marey.io.documents import read_json_table
from marey.pipelines.calibrate.content import summary_lines
from marey.pipelines.labelled import Summary
from marey.pipelines.result_files import ResultFiles, StoredResult

CAMERAS_FILE = "cameras.toml"
"""Name of the file with the cameras, which `marey capture` reads."""
DATA_FILE = "calibration.json"
"""Name of the file with covariances, errors and findings."""
REPORT_FILE = "calibration.html"
"""Name of the report of a calibration."""


class Calibration(StoredResult):
    """Calibrated cameras with their uncertainty.

    Args:
        files: The folder with all files of the run.

    Example:
        >>> import marey
        >>> calibration = marey.calibrate("session")  # doctest: +SKIP
        >>> calibration.cameras["cam01"].matrix  # doctest: +SKIP
    """

    _file, _report = DATA_FILE, REPORT_FILE

    def __init__(self, files: ResultFiles):
        super().__init__(files)

    @cached_property
    def data(self) -> dict[str, Any]:
        """All figures, as in `calibration.json`."""
        path = self._path(DATA_FILE)
        return read_json_table(path, "Give the results of `marey calibrate`.")

    @cached_property
    def cameras(self) -> Rig:
        """The cameras.

        Raises:
            FileProblem: The cameras recorded one at a time, so that only their lenses are known.
        """
        return read_toml(self._path(CAMERAS_FILE))

    @property
    def covariance(self) -> Floats:
        """(15 C, 15 C) covariance; `parameters` names the rows."""
        return np.array(self.data["covariance"]["matrix"], float)

    @property
    def parameters(self) -> tuple[str, ...]:
        """(15 C) names of the rows of the covariance, for example `cam01.fx`."""
        return tuple(self.data["covariance"]["parameters"])

    @property
    def findings(self) -> tuple[dict[str, str], ...]:
        """What is wrong or could be better: code, severity, text and advice of each finding."""
        return tuple(self.data["findings"])

    @property
    def usable(self) -> bool:
        """Whether no problem was found."""
        return all(each["severity"] != "problem" for each in self.findings)

    @property
    def path(self) -> Path:
        """The file with the cameras."""
        return self._path(CAMERAS_FILE)

    def _path(self, name: str) -> Path:
        assert self._files is not None
        return self._files.folder / name

    def summary(self) -> Summary:
        """Return the key figures, and what to do next."""
        lines = summary_lines(self.data)
        return Summary("Calibration", {str(k + 1): line for k, line in enumerate(lines)})

    def save(self, folder: Path | str) -> Path:
        """Write the calibration: the same files as `marey calibrate --out folder`.

        Args:
            folder: Folder for the files; it is created if it does not exist.

        Returns:
            The folder.

        Raises:
            FileProblem: The folder cannot be written to.
        """
        assert self._files is not None
        return self._files.save(folder, file=DATA_FILE)
