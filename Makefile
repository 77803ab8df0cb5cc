# Everything happens in .venv, made on first use from the locked versions. Python 3.11 or later, pip and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed

.PHONY: demo test test-slow check docs lock clean

demo: $(STAMP)  ## the main job on Hopper, small: record, calibrate, learn, evaluate
	rm -rf runs/demo
	$(BIN)/madoc run hopper-medium --out runs/demo --transitions 50000 --budget 80000 --policy-budget 20000 \
	  --policy-set "hidden=[128, 128]" --episodes 10

test: $(STAMP)  ## every test that takes seconds
	$(BIN)/python -m pytest -n 2 -rs

test-slow: $(STAMP)  ## the others
	$(BIN)/python -m pytest -n 2 -m slow

check: $(STAMP)  ## format, lint, types, layers
	$(BIN)/ruff format --check src tests benchmarks examples docs/hooks.py
	$(BIN)/ruff check src tests benchmarks examples docs/hooks.py
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: $(STAMP)  ## the site, in build/site; opens from there without a server or a network
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --clean

lock: $(STAMP)  ## write the installed versions down, without addresses
	$(BIN)/python -m pip freeze --exclude-editable > requirements.lock

$(STAMP): pyproject.toml requirements.lock
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	touch $(STAMP)

clean:  ## remove the environment, not your runs
	rm -rf $(VENV)
