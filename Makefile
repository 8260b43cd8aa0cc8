# Two commands do everything on a fresh machine with Python >= 3.11: make run, make test. make docs builds the site.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
OUT ?= runs/ball_sim

.PHONY: run test lint types imports unit fuzz moments bench docs figures dist release bom lock audit clean

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

# Each kernel is compiled once, where every worker of a fresh clone would compile them all. Bytecode is kept even where
# the environment says not to: each of some hundred processes would compile the sources anew.
unit: export PYTHONDONTWRITEBYTECODE =
unit: $(VENV)/.test
	$(BIN)/python -m tests.compile_kernels
	$(BIN)/pytest -n auto --durations 30

# damaged files, odd options and places that cannot be written, against every command that reads or writes them
FUZZ_INPUTS ?= 50000
FUZZ_SECONDS ?= 3600

fuzz: $(VENV)/.test
	$(BIN)/python -m tests.fuzz --inputs $(FUZZ_INPUTS) --seconds $(FUZZ_SECONDS) --faults fuzz_faults.json

# Ctrl-C, and a disk that fills, at random moments; the disk needs root
moments: $(VENV)/.test
	$(BIN)/python -m tests.fuzz.moments

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

release:
	.ci/release

# Everything is installed from the lock files, which name every version and the hashes of its files; pip's own
# configuration says where packages come from. make lock writes them anew where pyproject.toml asks for other packages.
LOCKED = -m pip install --disable-pip-version-check --require-hashes -r
SELF = -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .

$(VENV)/.run: pyproject.toml .ci/lock/run.txt
	$(PYTHON) -c 'import sys; sys.exit("Python >= 3.11 is needed, this is " + sys.version.split()[0] if sys.version_info < (3, 11) else 0)'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "Installing into $(VENV): about half a GB, one to five minutes. The first run then compiles for about half a minute."
	$(BIN)/python $(LOCKED) .ci/lock/run.txt
	$(BIN)/python $(SELF)
	touch $@

$(VENV)/.test: $(VENV)/.run .ci/lock/test.txt
	$(BIN)/python $(LOCKED) .ci/lock/test.txt --quiet
	touch $@

$(VENV)/.docs: $(VENV)/.run .ci/lock/docs.txt
	$(BIN)/python $(LOCKED) .ci/lock/docs.txt --quiet
	touch $@

$(VENV)/tools/.done: .ci/lock/tools.txt
	$(PYTHON) -m venv $(VENV)/tools
	$(VENV)/tools/bin/python $(LOCKED) .ci/lock/tools.txt --quiet
	touch $@

lock: $(VENV)/tools/.done
	$(VENV)/tools/bin/python -m pip install --quiet --disable-pip-version-check uv
	.ci/lock.sh $(VENV)/tools/bin/uv

audit: $(VENV)/tools/.done
	$(VENV)/tools/bin/python .ci/audit.py

# what the wheel of make dist needs, as a bill of materials beside it
bom: $(VENV)/tools/.done
	mkdir -p dist
	$(VENV)/tools/bin/cyclonedx-py requirements --pyproject pyproject.toml --mc-type library --output-reproducible \
		-o dist/relay_autotune.cdx.json .ci/lock/run.txt

clean:
	rm -rf docs/_build docs/api/autotune docs/api/drivers docs/api/sim $(VENV) .mypy_cache .ruff_cache .pytest_cache runs
