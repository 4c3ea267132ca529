"""The age of figures, on a small repository."""

import subprocess
from pathlib import Path

import pytest
from bench.provenance import age, current_commit, is_dirty, machine


def commit(project: Path, name: str, text: str) -> str:
    path = project / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    subprocess.run(["git", "add", "."], cwd=project, check=True)
    own = ["-c", "user.name=made", "-c", "user.email=made@example.org", "-c", "commit.gpgsign=false"]
    subprocess.run(["git", *own, "commit", "--quiet", "-m", f"Change {name}"], cwd=project, check=True)
    return current_commit(project)


@pytest.fixture
def project(tmp_path: Path) -> Path:
    subprocess.run(["git", "init", "--quiet", tmp_path], check=True)
    commit(tmp_path, "src/fit.py", '"""Fit."""\n\nWEIGHT = 1\n')
    return tmp_path


def test_figures_of_the_present_code_are_current(project: Path):
    assert not age(current_commit(project), ["src"], project).old


def test_a_change_elsewhere_leaves_figures_current(project: Path):
    measured = current_commit(project)
    commit(project, "docs/index.md", "Text.\n")
    assert age(measured, ["src"], project).commits == ()


def test_a_change_of_the_measured_code_makes_figures_old(project: Path):
    measured = current_commit(project)
    last = commit(project, "src/fit.py", '"""Fit."""\n\nWEIGHT = 2\n')
    found = age(measured, ["src"], project)
    assert found.old
    assert found.files == ("src/fit.py",)
    assert last.startswith(found.commits[0])


def test_a_removed_file_makes_figures_old(project: Path):
    commit(project, "src/other.py", "VALUE = 1\n")
    measured = current_commit(project)
    (project / "src" / "other.py").unlink()
    commit(project, "README.md", "Text.\n")
    assert age(measured, ["src"], project).files == ("src/other.py",)


def test_the_comparison_ends_at_the_first_changed_file_where_one_suffices(project: Path):
    measured = current_commit(project)
    commit(project, "src/fit.py", '"""Fit a body."""\n\nWEIGHT = 1\n')
    for name in ("src/later.py", "src/other.py"):
        commit(project, name, "VALUE = 1\n")
    assert age(measured, ["src"], project).files == ("src/later.py", "src/other.py")
    assert age(measured, ["src"], project, most=1).files == ("src/later.py",)


def test_a_change_of_wording_leaves_figures_current(project: Path):
    measured = current_commit(project)
    commit(project, "src/fit.py", '"""Fit a body."""\n\nWEIGHT = 1  # of a point\n"""Weight of a point."""\n')
    found = age(measured, ["src"], project)
    assert len(found.commits) == 1
    assert not found.old


def test_a_commit_that_is_not_in_the_history_makes_figures_old(project: Path):
    assert age("f" * 40, ["src"], project).old


def test_changes_that_are_not_committed_are_detected(project: Path):
    assert not is_dirty(["src"], project)
    (project / "src" / "fit.py").write_text("WEIGHT = 3\n")
    assert is_dirty(["src"], project)
    assert not is_dirty(["docs"], project)


def test_the_machine_is_described_without_its_name():
    import platform

    described = machine()
    assert {"processor", "cores", "python", "numpy", "numba"} <= set(described)
    assert platform.node() not in described.values()
