"""Errors are one line that a terminal shows, whatever a file or a library has written into them."""

from marey.errors import FileProblem


def test_a_problem_of_a_file_is_one_printable_line():
    problem = FileProblem("a.c3d", "cannot be read (the name E\x00\x01ZERO\n \x1b[31mUNITS\u202e)", "Export it again.")
    assert str(problem) == "a.c3d: cannot be read (the name E ZERO [31mUNITS ). Export it again."
    assert problem.wrong == "cannot be read (the name E ZERO [31mUNITS )"
