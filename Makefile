# Every target does its own set-up: the environment lives in .venv, pinned by constraints.txt.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: test demo lint accuracy clean

# A .venv without .ready is what an interrupted set-up left: begin anew. The checks need more than the program does.
.venv/.ready: pyproject.toml constraints.txt
	test -e $@ || rm -rf .venv
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	touch $@

.venv/.checks: .venv/.ready
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[test,knee]"
	touch $@

lint: .venv/.checks
	$(BIN)/ruff check .
	$(BIN)/mypy

test: lint
	$(BIN)/python -m pytest

demo: .venv/.ready
	$(BIN)/marey demo

# The pages under docs/accuracy, from the records that `python -m bench run NAME` has written.
accuracy:
	$(PYTHON) -m bench report

clean:
	rm -rf .venv
