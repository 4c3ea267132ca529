"""The files of a result: in the folder that the user named, or in a temporary one that lasts as long as the result."""

import json
import shutil
import tempfile
import weakref
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

from marey.errors import FileProblem
from marey.io.run_files import RECORD
from marey.pipelines.labelled import Described
from marey.pipelines.run_record import finished_together, record_of
from marey.pipelines.verdict import Verdict


@dataclass(frozen=True, eq=False)
class ResultFiles:
    """The folder with the files of a result."""

    folder: Path
    temporary: bool = False
    """Whether the folder is removed when the result is no longer used."""

    @staticmethod
    def at(out: Path | str | None) -> "ResultFiles":
        """Return a folder for results.

        Args:
            out: The folder; None for a temporary one.
        """
        if out is not None:
            return ResultFiles(Path(out))
        files = ResultFiles(Path(tempfile.mkdtemp(prefix="marey-")), temporary=True)
        weakref.finalize(files, shutil.rmtree, files.folder, ignore_errors=True)
        return files

    def record(self, file: str) -> dict[str, Any]:
        """Return the record of the run that wrote a file, as in `run.json`; empty if there is none.

        Args:
            file: Name of the file in the folder.
        """
        return record_of(self.folder, file)

    def path(self, file: str) -> Path | None:
        """Return the path of a file, or None if there is no such file."""
        path = self.folder / file
        return path if path.is_file() else None

    def save(self, out: Path | str, *, file: str) -> Path:
        """Copy all files of the run that wrote a file to another folder.

        The folder then holds the same files as if the command had been run with `--out`.

        Args:
            out: Folder for the files; results of other commands in it are kept.
            file: A file that the run wrote.

        Returns:
            The folder.

        Raises:
            FileProblem: The folder cannot be written to, or one of the files no longer exists.
        """
        out = Path(out)
        if out.resolve() == self.folder.resolve():
            return out
        record = self.record(file)
        everything = [path.relative_to(self.folder) for path in self.folder.rglob("*") if path.is_file()]
        names = [Path(name) for name in record["files"]] if record else everything
        with finished_together(out) as staging:
            for name in (name for name in names if name != Path(RECORD)):
                if not (self.folder / name).is_file():
                    raise FileProblem(self.folder / name, "no longer exists", "Run the command again.")
                (staging / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(self.folder / name, staging / name)
            if record:
                text = json.dumps(record, indent=2, ensure_ascii=False) + "\n"
                (staging / RECORD).write_text(text, encoding="utf-8")
        return out


class StoredResult(Described):
    """A result whose files are in a folder, which may be a temporary one.

    Args:
        files: The folder with all files of the run; None for a part of a result.
    """

    _file: ClassVar[str]
    """The file by which the record of the run is found."""
    _report: ClassVar[str]
    """Name of the report."""

    def __init__(self, files: ResultFiles | None):
        self._files = files

    @property
    def folder(self) -> Path | None:
        """Folder of the files, which may be a temporary one; None for a part of a result."""
        return None if self._files is None else self._files.folder

    @property
    def report(self) -> Path | None:
        """Path of the report (an HTML page); None if there is none."""
        return None if self._files is None else self._files.path(self._report)

    @cached_property
    def record(self) -> dict[str, Any]:
        """Version, settings, inputs, timings and warnings of the run, as in `run.json`."""
        return {} if self._files is None else self._files.record(self._file)

    @property
    def verdict(self) -> Verdict | None:
        """How far the result can be used, and what limits it; None for a result of an earlier version."""
        return Verdict.from_record(self.record)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings of the run, one sentence each."""
        return tuple(self.record.get("warnings", ()))
