import pytest
from tests import performer

from marey.cli.main import run
from marey.io.results.results import write_results


def test_where_two_commands_left_pages_both_are_found(tmp_path, capsys):
    for name in ("report.html", "knee.html"):
        (tmp_path / name).touch()
    assert run(["view", str(tmp_path), "--no-browser"]) == 0
    printed = capsys.readouterr()
    assert printed.out.strip() == str((tmp_path / "report.html").resolve())
    assert printed.err.strip() == f"Further report: {(tmp_path / 'knee.html').resolve()}"
    assert run(["view", str(tmp_path / "knee.html"), "--no-browser"]) == 0
    assert capsys.readouterr().out.strip() == str((tmp_path / "knee.html").resolve())


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captured") / "walk"
    person = performer.body()
    write_results(folder, performer.motion(person), person, preset="full")
    return folder


def test_a_captured_motion_is_written_as_one_page(captured, tmp_path, capsys):
    page = tmp_path / "walk.html"
    assert run(["view", str(captured), "--file", str(page), "--no-browser"]) == 0
    printed = capsys.readouterr()
    assert printed.out.strip() == str(page)
    assert "--trial" in printed.err
    assert '<span class="result">' in page.read_text(encoding="utf-8")


def test_the_page_is_served_until_it_is_ended(captured, capsys, monkeypatch):
    served = []
    monkeypatch.setattr("marey.pipelines.viewer.viewer.serve_viewer", lambda server: served.append(server))
    assert run(["view", str(captured), "--no-browser", "--quiet"]) == 0
    served[0].server_close()
    assert f"The page is at {served[0].address}." in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["{walk}", "{nothing}"], "holds neither motion.npz nor bones.npz"),
        (["{walk}", "{nothing}/missing"], "does not exist"),
        (["{nothing}"], "holds no report.html"),
        (["{walk}", "{walk}", "{walk}"], "3 results were given"),
        (["{walk}", "--offset", "1"], "no second result"),
        (["{walk}", "--file", "{nothing}/walk.npz"], "ends in .html"),
        (["{walk}", "--trial", "{nothing}/missing"], "does not exist"),
        (["{walk}", "--port", "70000"], "Invalid value for '--port'"),
    ],
)
def test_wrong_input_is_one_line(captured, tmp_path, capsys, arguments, line):
    filled = [each.format(walk=captured, nothing=tmp_path) for each in arguments]
    assert run(["view", *filled, "--no-browser", "--quiet"]) == 2
    printed = capsys.readouterr().err
    assert line in printed
    assert printed.count("\n") == 1
