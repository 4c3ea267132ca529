"""study.toml: what is read, and what is wrong in one line."""

import pytest

from marey.errors import FileProblem
from marey.io.study.settings import filled, path_texts, read_study

SHORT = 'pattern = "{subject}/{condition}_*"\n[[steps]]\ncommand = "capture"\nstature = 1.8\n'


def study_of(folder, text: str):
    (folder / "study.toml").write_text(text)
    return read_study(folder)


def test_settings_of_subjects_and_trials_replace_those_of_the_steps(tmp_path):
    settings = study_of(
        tmp_path, SHORT + "overlay = false\n[subjects.S01]\nstature = 1.6\n[trials.'S01/run_2']\nframes = [0, 9]\n"
    )
    trials = [("S02/run_1", "S02"), ("S01/run_1", "S01"), ("S01/run_2", "S01")]
    usual, small, short = (next(settings.steps_of(*names)).given() for names in trials)
    assert usual == {"overlay": False, "stature": 1.8}
    assert small == {"overlay": False, "stature": 1.6}
    assert short == {"overlay": False, "stature": 1.6, "frames": (0, 9)}


def test_each_subject_may_have_measurements_and_each_step_a_person(tmp_path):
    text = '[[steps]]\ncommand = "markers"\nperson = "Ann"\n'
    text += "measurements = {knee_width_mm = 99, ankle_width_mm = 65.5}\n"
    settings = study_of(tmp_path, text + "[subjects.S01]\nmeasurements = {knee_width_mm = 105}\n")
    usual, own = (next(settings.steps_of(*names)).given() for names in (("S02/run", "S02"), ("S01/run", "S01")))
    assert usual == {"person": "Ann", "measurements": {"knee_width_mm": 99.0, "ankle_width_mm": 65.5}}
    assert own == {"person": "Ann", "measurements": {"knee_width_mm": 105.0}}


def test_paths_are_known_and_their_placeholders_filled(tmp_path):
    text = '[[steps]]\ncommand = "markers"\nstatic = "{folder}/static.c3d"\nfunctional = ["{subject}_hip.c3d"]\n'
    (step,) = study_of(tmp_path, text).steps
    found = {name: filled(path, {"folder": "S01/a", "subject": "S01"}) for name, path in path_texts(step)}
    assert found == {"static": "S01/a/static.c3d", "functional": "S01_hip.c3d"}


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        (SHORT + "[extra]\n", "has the unknown key 'extra'. The known keys are pattern, exclude"),
        (SHORT + "statur = 2\n", "has the unknown key 'steps.1.statur'. A step capture has the keys command, name"),
        ('pattern = "*"\n', "has no steps."),
        ("[[steps]]\nstature = 1.8\n", "whose command should be capture, surface, shape or markers"),
        ('[[steps]]\ncommand = "knee"\n', "whose command should be capture, surface, shape or markers"),
        (SHORT + SHORT.split("\n", 1)[1], "has two steps with the name 'capture'"),
        (SHORT + "[subjects.S01]\nheight = 2\n", "has the unknown key 'height' in [subjects.S01]"),
        (SHORT + "[subjects.S01]\nstature = 'tall'\n", "has stature = 'tall', which is invalid"),
        (SHORT.replace("{condition}", "{day}"), "has {day} in the pattern"),
        (SHORT + 'body = "{where}/body.npz"\n', "has {where} in body of the step capture"),
        (SHORT.replace("1.8", '"1.8"'), "has steps.1.stature = '1.8', which is invalid (it should be a number)"),
        ("steps = []\n", "has no steps."),
        ("[[steps]\n", "is not TOML"),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path, text, wrong):
    with pytest.raises(FileProblem) as error:
        study_of(tmp_path, text)
    assert wrong in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_file_and_a_missing_folder_are_named(tmp_path):
    with pytest.raises(FileProblem, match=r"study.toml: does not exist. A short one is: pattern"):
        read_study(tmp_path)
    with pytest.raises(FileProblem, match=r"nowhere: does not exist. Give the folder that holds study.toml"):
        read_study(tmp_path / "nowhere")
