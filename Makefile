# Everything happens in .venv, made on first use from the locked versions. Python 3.11 or later, pip and make.
# requirements.lock is what running Madoc needs; requirements-dev.lock is what tests, linters and docs need besides.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUNS := $(VENV)/runs
SEED ?= 0
TESTS := $(VENV)/tests
WORKERS := -n auto --maxprocesses 4  # one for each core, 4 at most
# The oldest and the newest MuJoCo; 4.x by its core, which has all that Madoc imports of it.
MUJOCO := mujoco==3.8.0 mujoco-core==4.0.1
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet

.PHONY: demo test test-slow test-versions test-exports wheel check types style layers figures docs lock clean

DEMO := examples/reach
demo: $(RUNS)  ## the main job on an arm with an unknown load: logs, calibration, policies, evaluation; SEED=1 is another
	rm -rf runs/demo runs/demo-logs
	$(BIN)/python examples/record_logs.py $(DEMO)/reach.yaml $(DEMO)/truth.json runs/demo-logs --seed $(SEED)
	$(BIN)/madoc run $(DEMO)/reach.yaml --data runs/demo-logs --truth $(DEMO)/truth.json --out runs/demo --seed $(SEED) \
	  --episodes 50 --policy-budget 250000 --policy-set hidden=[64,64] environments=32 epoch_steps=1024 \
	  steps_per_update=4 warmup_steps=5000 judge_every=5000 judge_episodes=50
	@echo
	@echo "The policies at work, and which error matters to them: open runs/demo/report.html"
	@echo "Another estimate, another policy:  $(BIN)/madoc learn runs/demo --at distribution --width 3 --budget 60s"
	@echo "Your own robot, from its model:    $(BIN)/madoc init robot.xml, then docs/how-to/own-policy.md"
	@echo "The paper's robots:                $(BIN)/madoc run hopper-medium --policy-budget 300s"

# Whole runs call what the other tests call: annotated shapes, a quarter of their time, are checked in these alone.
WHOLE := tests/cli tests/conformance tests/faults tests/recovery tests/suites
test: $(TESTS)  ## every test that takes seconds
	SHAPES=0 $(BIN)/python -m pytest $(WORKERS) --dist worksteal -rs $(WHOLE)
	$(BIN)/python -m pytest $(WORKERS) --dist worksteal -rs $(addprefix --ignore=,$(WHOLE))

test-slow: $(TESTS)  ## the others
	$(BIN)/python -m pytest $(WORKERS) --dist worksteal -m slow

# A folder with one MuJoCo alone, ahead of the locked packages on the path, so that everything else is as in the lock.
test-versions: $(TESTS)  ## every test that takes seconds, with the oldest and the newest MuJoCo
	set -e; for one in $(MUJOCO); do folder=$(abspath $(VENV))/$$one; \
	  test -d $$folder/mujoco || $(PIP) install --no-deps --target $$folder $$one; \
	  echo "$$one:"; PYTHONPATH=$$folder$${PYTHONPATH:+:$$PYTHONPATH} $(BIN)/python -m pytest $(WORKERS) --dist worksteal -rs; \
	done

STACKS := $(VENV)/stacks
test-exports: $(TESTS)  ## the tests of exports beside the libraries they are for, installed in an environment of their own
	test -x $(STACKS)/bin/python || $(PYTHON) -m venv $(STACKS)
	$(STACKS)/bin/python -m pip --disable-pip-version-check --quiet install mjlab==1.6.0 mujoco-mjx playground==0.2.0 \
	  --editable .[dev,view]
	$(STACKS)/bin/python -m pytest -rs tests/export

WHEEL := $(VENV)/wheel
wheel: $(TESTS)  ## the package as others get it: built, installed in an empty environment, and an arm calibrated with it
	rm -rf $(WHEEL) && $(BIN)/python -m build --outdir $(WHEEL)/dist . > /dev/null
	$(PYTHON) -m venv $(WHEEL)/env
	$(WHEEL)/env/bin/python -m pip --disable-pip-version-check --quiet install -r requirements.lock $(WHEEL)/dist/*.whl
	$(WHEEL)/env/bin/madoc --version
	$(WHEEL)/env/bin/python examples/record_logs.py examples/arm/arm.yaml examples/arm/truth.json $(WHEEL)/logs
	$(WHEEL)/env/bin/madoc calibrate examples/arm/arm.yaml --data $(WHEEL)/logs --out $(WHEEL)/run --quiet
	$(WHEEL)/env/bin/madoc report $(WHEEL)/run

check: types style layers  ## format, lint, types, layers; at once with -j

types: $(TESTS)
	$(BIN)/mypy

style: $(TESTS)
	$(BIN)/ruff format --check src tests benchmarks examples docs/hooks.py
	$(BIN)/ruff check src tests benchmarks examples docs/hooks.py

layers: $(TESTS)
	$(BIN)/lint-imports

figures: $(TESTS)  ## every measured table and picture of the README and of the documentation, from committed results
	$(BIN)/python benchmarks/tables.py > /dev/null
	$(BIN)/python benchmarks/paper.py > /dev/null
	$(BIN)/python benchmarks/embedding.py > /dev/null

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
