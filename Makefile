# Everything happens in .venv, made on first use from the locked versions. Python 3.11 or later, pip and make.
# requirements.lock is what running Madoc needs; requirements-dev.lock is what tests, linters and docs need besides.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUNS := $(VENV)/runs
TESTS := $(VENV)/tests
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet

.PHONY: demo test test-slow check docs lock clean

demo: $(RUNS)  ## the main job on Hopper, small: record, calibrate, learn, evaluate
	rm -rf runs/demo
	$(BIN)/madoc run hopper-medium --out runs/demo --transitions 50000 --budget 80000 --policy-budget 60s --episodes 10

test: $(TESTS)  ## every test that takes seconds
	$(BIN)/python -m pytest -n 2 -rs

test-slow: $(TESTS)  ## the others
	$(BIN)/python -m pytest -n 2 -m slow

check: $(TESTS)  ## format, lint, types, layers
	$(BIN)/ruff format --check src tests benchmarks examples docs/hooks.py
	$(BIN)/ruff check src tests benchmarks examples docs/hooks.py
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: $(TESTS)  ## the site, in build/site; opens from there without a server or a network
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --clean

lock: $(TESTS)  ## write the installed versions down, without addresses: what running needs, and the rest
	$(BIN)/python -m pip freeze --exclude-editable > $(VENV)/all.txt
	rm -rf $(VENV)/lock && $(BIN)/python -m venv $(VENV)/lock
	$(VENV)/lock/bin/python -m pip install --quiet --disable-pip-version-check --constraint $(VENV)/all.txt .
	$(VENV)/lock/bin/python -m pip freeze --exclude madoc-calibration > requirements.lock
	grep --invert-match --line-regexp --fixed-strings --file requirements.lock $(VENV)/all.txt > requirements-dev.lock

$(RUNS): pyproject.toml requirements.lock
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) install -r requirements.lock
	$(PIP) install --no-deps --editable .
	touch $(RUNS)

$(TESTS): $(RUNS) requirements-dev.lock
	$(PIP) install -r requirements-dev.lock
	touch $(TESTS)

clean:  ## remove the environment, not your runs
	rm -rf $(VENV)
