"""Hashes of the inputs of a step: what a trial holds, and what the record of its last run names."""

import hashlib
from collections.abc import Iterator
from pathlib import Path

from marey.io.run_files import RECORD, read_record
from marey.io.stages import file_fingerprint
from marey.io.work_folder import WORK


def trial_fingerprint(path: Path) -> str:
    """Return a hash of a file, or of the names and contents of all files of a folder but results of marey in it.

    Args:
        path: The file or folder.

    Returns:
        32 hexadecimal digits.

    Raises:
        FileProblem: A file cannot be read.
    """
    if not path.is_dir():
        return file_fingerprint(path)
    digest = hashlib.blake2b(digest_size=16)
    for file in _files(path):
        digest.update(file.relative_to(path).as_posix().encode("utf-8", "surrogateescape") + b"\0")
        digest.update(file_fingerprint(file).encode())
    return digest.hexdigest()


def _files(folder: Path) -> Iterator[Path]:
    for path in sorted(folder.iterdir()):
        if path.is_dir():
            if path.name != WORK and read_record(path).get("program") != "marey":
                yield from _files(path)
        elif path.is_file():
            yield path


def recorded_inputs_are_unchanged(results: Path, root: Path, *, known: frozenset[str] = frozenset()) -> bool:
    """Return whether the files that a run has read are as they were.

    This finds changes in files that other files name, such as the mesh of a body or the calibration of a session.

    Args:
        results: Folder with the results of the run.
        root: The folder to which the names of the inputs are relative.
        known: Hashes of files that are known to exist, possibly under another name since.
    """
    recorded = read_record(results).get("inputs", {})
    for name, digest in recorded.items():
        path = root / name
        if digest not in known and (not path.exists() or file_fingerprint(path) != digest):
            return False
    return (results / RECORD).is_file()
