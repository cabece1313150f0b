# `make demo` and `make test` include all set-up; both need only Python 3.11 or 3.12 and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --quiet --disable-pip-version-check install --no-compile -c constraints.txt
DEMO_SCENES := homes/tuning0 homes/tuning1 homes/tuning2 homes/tuning3

.PHONY: demo test test-quick proofs mutants bench bench-methods reference architecture docs lint clean

demo: $(VENV)/core
	$(BIN)/su3d-bench run --scenes $(DEMO_SCENES) --methods opensu3d oracle --protocols homes-semantic homes-instance --stride 80 --no-pictures --out runs/demo
	$(BIN)/su3d-bench report html runs/demo --out runs/demo.html

test: $(VENV)/test
	$(BIN)/python -m pytest -q -n auto

# Tests of the metrics (against the original evaluators, to the last bit), and each verb once.
QUICK := tests/metrics tests/evaluation/test_evaluate_cases.py tests/cli/test_each_verb.py tests/test_suite_rules.py
test-quick: $(VENV)/test
	$(BIN)/python -m pytest -q -n auto $(QUICK)

# Long tests of docs/running/reliability.md: half an hour on two cores; the disks only as root.
proofs: $(VENV)/test
	@mkdir -p build/measured
	$(BIN)/python -m pytest -q -n auto -m proof
	SU3D_FUZZ_EXAMPLES=60 $(BIN)/python -m pytest -q -n auto tests/test_fuzz.py
	SU3D_DAMAGES=2000 $(BIN)/python -m pytest -q -n auto -k damage
	$(BIN)/python benchmarks fuzz --inputs 100000 --seed 1 --json build/measured/fuzz.json
	$(BIN)/python benchmarks coverage_of_intervals
	$(BIN)/python benchmarks kill_at_random --kills 200 --json build/measured/kills.json
	if [ "$$(id -u)" = 0 ]; then $(BIN)/python benchmarks full_disk --disks 20; fi

# Mutation testing of metrics, statistics, comparison and regression check: lists undetected faults. Takes hours.
mutants: $(VENV)/test
	@mkdir -p build/measured
	$(BIN)/python benchmarks mutants --mutants 600 --json build/measured/mutants.json

bench: $(VENV)/test
	@mkdir -p build
	$(BIN)/python -m pytest benchmarks --benchmark-only --benchmark-group-by=group --benchmark-columns=min,median,rounds --benchmark-json=build/bench.json
	$(BIN)/python benchmarks write_performance build/bench.json

# All methods on corridors long enough for maps of 5 million points: half an hour on two cores.
CORRIDOR_RUN := $(BIN)/su3d-bench run --profile oracle --stride 1 --no-pictures --set perception.cache=false --jobs 1
CORRIDOR := benchmarks/scale/corridor.py:Corridor
bench-methods: $(VENV)/test
	$(CORRIDOR_RUN) --scenes $(CORRIDOR)/930m --methods opensu3d conceptfusion conceptfusion-sam sam3d@incremental conceptgraphs --out runs/bench-corridor
	$(CORRIDOR_RUN) --scenes $(CORRIDOR)/310m --methods conceptgraphs-detector --out runs/bench-corridor-detector
	$(CORRIDOR_RUN) --scenes $(CORRIDOR)/10m $(CORRIDOR)/30m $(CORRIDOR)/100m $(CORRIDOR)/300m $(CORRIDOR)/1000m --limit 20 --set corridor.step_m=0.5 --methods openmask3d openmask3d-segment3d --out runs/bench-corridor-scans
	$(BIN)/python benchmarks write_performance build/bench.json --corridors runs/bench-corridor runs/bench-corridor-detector runs/bench-corridor-scans

# Creates the reference for the regression check in .ci/run; commit it with the change that affects results. The limits
# are wide because CI machines and their load vary.
reference: demo
	$(BIN)/su3d-bench check --build-from runs/demo --out .ci/reference.json --machine-tolerance 5 --cost-limit 3

# Generates the tables of docs/architecture.md from the code.
architecture: $(VENV)/test
	$(BIN)/python tools/docs/architecture.py

# The documentation site, which works from disk: open build/site/index.html. Not --quiet: mkdocs would not count
# warnings, and --strict would have no effect.
docs: $(VENV)/docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

lint: $(VENV)/dev
	$(BIN)/python .ci/check_budget.py
	$(BIN)/python .ci/check_words.py
	$(BIN)/codespell su3d_bench datasets baselines reports benchmarks tests tools docs .ci *.md *.toml *.yml Makefile
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

$(VENV)/core: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if (3, 11) <= v < (3, 13) else f"Python {v[0]}.{v[1]} found; su3d-bench needs 3.11 or 3.12: make PYTHON=python3.11 ...")'
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo 'Installing su3d-bench and its dependencies into $(VENV): 2.2 GB on disk, a few minutes'
	@$(PIP) -e .
	@touch $@

$(VENV)/docs: $(VENV)/core
	@echo 'Installing the documentation tools into $(VENV): 0.1 GB on disk, under a minute'
	@$(PIP) -e '.[docs]'
	@touch $@

$(VENV)/test: $(VENV)/core
	@echo 'Installing the test dependencies, PyTorch among them, into $(VENV): 1.8 GB on disk, a few minutes'
	@$(PIP) -e '.[models,slurm,test]'
	@touch $@

$(VENV)/dev: $(VENV)/test
	@echo 'Installing the linters into $(VENV): 0.1 GB on disk, under a minute'
	@$(PIP) -e '.[models,slurm,test,dev]'
	@touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
