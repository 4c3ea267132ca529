import json

import pytest

from marey.errors import FileProblem
from marey.io.run_files import files_of_runs, read_record, require_own_folder


def write_record(folder, *files, **more):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "run.json").write_text(json.dumps({"command": "capture", "files": list(files), **more}))


def test_the_files_of_all_runs_in_a_folder_are_known(tmp_path):
    write_record(tmp_path, "a.npz", "run.json", earlier={"surface": {"files": ["surface.npz"]}})
    assert files_of_runs(tmp_path) == {"a.npz", "run.json", "surface.npz"}


@pytest.mark.parametrize(
    "text", ["", "[]", "{", '{"files": 3}', '{"files": [], "earlier": [1]}', "[" * 100_000, '{"earlier": {"x": 1}}']
)
def test_a_folder_without_a_sound_record_has_no_files_of_ours(tmp_path, text):
    (tmp_path / "run.json").write_text(text)
    assert files_of_runs(tmp_path) == frozenset()
    assert isinstance(read_record(tmp_path), dict)


def test_a_folder_with_inputs_is_not_a_folder_for_results(tmp_path):
    for name in ("walk.c3d", "b.npz", "c.npz", "d.npz"):
        (tmp_path / name).write_text("mine")
    inputs = [tmp_path / "walk.c3d", tmp_path / "b.npz", tmp_path / "c.npz", tmp_path / "d.npz"]
    with pytest.raises(FileProblem, match=r"contains inputs of this run \(walk.c3d\), which results could replace"):
        require_own_folder(tmp_path, inputs[:1])
    with pytest.raises(FileProblem, match=r"\(b.npz, c.npz, d.npz and 1 more\)"):
        require_own_folder(tmp_path / "sub" / "..", inputs)
    require_own_folder(tmp_path / "marey", inputs)
    require_own_folder(tmp_path.parent, [tmp_path, *inputs])


def test_the_trial_itself_is_not_a_folder_for_results(tmp_path):
    with pytest.raises(FileProblem, match="is an input of this run"):
        require_own_folder(tmp_path, [tmp_path])


def test_a_link_to_a_folder_with_inputs_is_found(tmp_path):
    (tmp_path / "trial").mkdir()
    (tmp_path / "trial" / "walk.c3d").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "trial")
    with pytest.raises(FileProblem, match="contains inputs"):
        require_own_folder(tmp_path / "link", [tmp_path / "trial" / "walk.c3d"])


def test_results_of_other_commands_may_be_inputs(tmp_path):
    (tmp_path / "surface.npz").write_text("ours")
    with pytest.raises(FileProblem, match="contains inputs"):
        require_own_folder(tmp_path, [tmp_path / "surface.npz"])
    write_record(tmp_path, "surface.npz", "run.json")
    require_own_folder(tmp_path, [tmp_path / "surface.npz"])
