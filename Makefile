# Every target does its own set-up: the environment lives in .venv, pinned by constraints.txt.
PYTHON ?= python3
VENV ?= .venv
WORKERS ?= auto
BIN := $(VENV)/bin
INSTALL = $(BIN)/python -m pip install --quiet --constraint constraints.txt
# A file with the hash of everything that is installed, as .ci/run gives it. Nothing with another hash is installed then.
HASHES ?=

# Freed memory is kept for later use, as the program does: new memory from the system costs 4 % of the time of the tests.
# Bytecode is kept even where a setting forbids it: else each worker, and each program that a test starts, compiles the
# modules again, and collecting the tests takes twice the time.
PYTEST = PYTHONDONTWRITEBYTECODE= MALLOC_MMAP_THRESHOLD_=33554432 MALLOC_TRIM_THRESHOLD_=268435456 $(BIN)/python -m pytest

.PHONY: test slow quick demo knee lint docs dist accuracy hashes clean

# A folder without .ready is left over from an interrupted set-up: start again. The checks need more than the program does.
$(VENV)/.ready: pyproject.toml constraints.txt
	test -e $@ || rm -rf $(VENV)
	$(PYTHON) -m venv $(VENV)
ifeq ($(HASHES),)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(INSTALL) --editable .
else
	$(BIN)/python -m pip install --quiet --require-hashes --requirement $(HASHES)
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
endif
	$(BIN)/python -m compileall -q src
	touch $@

$(VENV)/.checks: $(VENV)/.ready
	test -n "$(HASHES)" || $(INSTALL) --editable ".[test,knee,plot,xarray,study,docs]"
	touch $@

lint: $(VENV)/.checks
	$(BIN)/ruff check .
	$(BIN)/mypy

# A worker that is finished takes over tests of another one; till then each goes through whole files in order, so that
# what the tests of a file share is computed once.
SIDE_BY_SIDE = -n $(WORKERS) --dist worksteal

# At most five minutes on two cores if the kernels were compiled before: everything but the tests marked slow, which
# `make slow` runs.
# mypy uses one core only and runs beside the tests, which give way to it; its messages follow theirs.
test: $(VENV)/.checks
	$(BIN)/ruff check .
	@mkdir -p build
	@$(BIN)/mypy > build/mypy.log 2>&1 & types=$$!; \
	trap 'kill $$types 2> /dev/null; exit 130' INT TERM; \
	set -- $(SIDE_BY_SIDE) -m "not slow"; echo "pytest $$*"; nice -n 5 env $(PYTEST) "$$@"; failed=$$?; \
	wait $$types || failed=1; echo "$(BIN)/mypy"; cat build/mypy.log; exit $$failed

# The tests marked slow: whole pipelines and large phantoms. Continuous integration runs them after `make test`.
slow: $(VENV)/.checks
	$(PYTEST) $(SIDE_BY_SIDE) -m slow

# The tests of `make test` alone, without style and types.
quick: $(VENV)/.checks
	$(PYTEST) $(SIDE_BY_SIDE) -m "not slow"

$(VENV)/.docs: $(VENV)/.ready
	$(INSTALL) --editable ".[docs]"
	touch $@

# The site in site/. A warning, such as a link that leads nowhere, is an error.
docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "Documentation: site/index.html"

demo: $(VENV)/.ready
	$(BIN)/marey demo

# The packages that `marey knee` needs besides the program's own.
knee: $(VENV)/.ready
	$(INSTALL) --editable ".[knee]"

# A wheel and a source archive in dist/, then each of them in a clean environment: it must start and find its example.
dist: $(VENV)/.ready
	rm -rf dist build/dist-check
	$(INSTALL) build
	$(BIN)/python -m build --outdir dist .
	for archive in dist/*.whl dist/*.tar.gz; do \
		rm -rf build/dist-check && $(PYTHON) -m venv build/dist-check && \
		build/dist-check/bin/python -m pip install --quiet --constraint constraints.txt $$archive && \
		(cd build && dist-check/bin/python -c "import marey; print(marey.example_folder())" && \
		dist-check/bin/marey --version) || exit 1; \
	done

# What .ci/run may install, for both versions of Python that it uses. Run it after a change of constraints.txt.
hashes: $(VENV)/.ready
	$(BIN)/python .ci/hashes.py .ci/hashes-3.11.txt
	python3.13 .ci/hashes.py .ci/hashes-3.13.txt

# The pages under docs/accuracy, from the records that `python -m bench run NAME` has written.
accuracy: $(VENV)/.ready
	$(BIN)/python -m bench report

clean:
	rm -rf .venv .venv-* build dist
