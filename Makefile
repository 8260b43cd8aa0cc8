# Two commands do everything on a fresh machine with Python >= 3.11: make run, make test. make docs builds the site.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
OUT ?= runs/ball_sim

.PHONY: run test lint types imports unit fuzz bench docs figures dist clean

run: $(VENV)/.run
	rm -rf $(OUT)
	$(BIN)/autotune run configs/ball_sim.toml --out $(OUT)

test: lint types imports unit

lint: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.test
	$(BIN)/mypy

imports: $(VENV)/.test
	$(BIN)/lint-imports

unit: $(VENV)/.test
	$(BIN)/pytest -n auto

# damaged files, odd options and places that cannot be written, against every command that reads or writes them
FUZZ_INPUTS ?= 50000
FUZZ_SECONDS ?= 3600

fuzz: $(VENV)/.test
	$(BIN)/python -m tests.fuzz --inputs $(FUZZ_INPUTS) --seconds $(FUZZ_SECONDS) --faults fuzz_faults.json

bench: $(VENV)/.test
	$(BIN)/python -m tests.benchmarks

docs: $(VENV)/.docs
	rm -rf docs/api/autotune docs/api/drivers docs/api/sim docs/_build
	$(BIN)/sphinx-build -q -W --keep-going -b html docs docs/_build
	@echo "site: docs/_build/index.html"

figures: $(VENV)/.docs
	$(BIN)/python -m docs.draw_figures

dist:
	.ci/dist

$(VENV)/.run: pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit("Python >= 3.11 is needed, this is " + sys.version.split()[0] if sys.version_info < (3, 11) else 0)'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "Installing into $(VENV): about half a GB, one to five minutes. The first run then compiles for about a minute."
	$(BIN)/python -m pip install --disable-pip-version-check -e .
	touch $@

$(VENV)/.test: $(VENV)/.run
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[test]'
	touch $@

$(VENV)/.docs: $(VENV)/.run
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[docs]'
	touch $@

clean:
	rm -rf docs/_build docs/api/autotune docs/api/drivers docs/api/sim $(VENV) .mypy_cache .ruff_cache .pytest_cache runs
