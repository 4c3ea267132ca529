from marey.cli.main import run


def test_where_two_commands_left_pages_both_are_found(tmp_path, capsys):
    for name in ("report.html", "knee.html"):
        (tmp_path / name).touch()
    assert run(["view", str(tmp_path), "--no-browser"]) == 0
    printed = capsys.readouterr()
    assert printed.out.strip() == str((tmp_path / "report.html").resolve())
    assert printed.err.strip() == f"Further report: {(tmp_path / 'knee.html').resolve()}"
    assert run(["view", str(tmp_path / "knee.html"), "--no-browser"]) == 0
    assert capsys.readouterr().out.strip() == str((tmp_path / "knee.html").resolve())
