# `make demo` and `make test` do all set-up themselves; both need only Python 3.11 or 3.12 and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --quiet --disable-pip-version-check install --no-compile -c constraints.txt
DEMO_SCENES := rooms/living0 rooms/bedroom0 rooms/kitchen0 rooms/office0

.PHONY: demo test test-quick proofs mutants bench bench-methods reference architecture docs lint clean

demo: $(VENV)/core
	$(BIN)/su3d-bench run --scenes $(DEMO_SCENES) --methods opensu3d oracle --protocols rooms-semantic rooms-instance --out runs/demo
	$(BIN)/su3d-bench report html runs/demo --out runs/demo/page.html

test: $(VENV)/test
	$(BIN)/python -m pytest -q -n auto

# What guards the numbers (what the original evaluators answer, to the last bit), and each verb once.
QUICK := tests/metrics tests/evaluation/test_evaluate_cases.py tests/cli/test_each_verb.py tests/test_suite_rules.py
test-quick: $(VENV)/test
	$(BIN)/python -m pytest -q -n auto $(QUICK)

# What docs/running/reliability.md claims, at length: half an hour on two cores, the disks as root alone.
proofs: $(VENV)/test
	@mkdir -p build/measured
	$(BIN)/python -m pytest -q -n auto -m proof
	SU3D_FUZZ_EXAMPLES=60 $(BIN)/python -m pytest -q -n auto tests/test_fuzz.py
	SU3D_DAMAGES=2000 $(BIN)/python -m pytest -q -n auto -k damage
	$(BIN)/python benchmarks fuzz --inputs 100000 --seed 1 --json build/measured/fuzz.json
	$(BIN)/python benchmarks coverage_of_intervals
	$(BIN)/python benchmarks kill_at_random --kills 200 --json build/measured/kills.json
	if [ "$$(id -u)" = 0 ]; then $(BIN)/python benchmarks full_disk --disks 20; fi

# Faults planted in metrics, statistics, comparison and gate, one at a time: which do the tests not notice? Hours.
mutants: $(VENV)/test
	@mkdir -p build/measured
	$(BIN)/python benchmarks mutants --mutants 600 --json build/measured/mutants.json

bench: $(VENV)/test
	@mkdir -p build
	$(BIN)/python -m pytest benchmarks --benchmark-only --benchmark-group-by=group --benchmark-columns=min,median,rounds --benchmark-json=build/bench.json
	$(BIN)/python benchmarks write_performance build/bench.json

# All methods on the demo rooms, and along corridors so long that every map reaches 5 million points: on two cores three
# quarters of an hour for the rooms and half an hour for the corridors.
CORRIDOR_RUN := $(BIN)/su3d-bench run --profile oracle --stride 1 --no-pictures --set perception.cache=false --jobs 1
CORRIDOR := benchmarks/scale/corridor.py:Corridor
bench-methods: $(VENV)/test
	$(BIN)/su3d-bench run --scenes $(DEMO_SCENES) --methods all --protocols rooms-semantic rooms-instance --no-pictures --out runs/bench-rooms
	$(CORRIDOR_RUN) --scenes $(CORRIDOR)/930m --methods opensu3d conceptfusion conceptfusion-sam sam3d@incremental conceptgraphs --out runs/bench-corridor
	$(CORRIDOR_RUN) --scenes $(CORRIDOR)/310m --methods conceptgraphs-detector --out runs/bench-corridor-detector
	$(CORRIDOR_RUN) --scenes $(CORRIDOR)/10m $(CORRIDOR)/30m $(CORRIDOR)/100m $(CORRIDOR)/300m $(CORRIDOR)/1000m --limit 20 --set corridor.step_m=0.5 --methods openmask3d openmask3d-segment3d --out runs/bench-corridor-scans
	$(BIN)/python benchmarks write_performance build/bench.json --rooms runs/bench-rooms --corridors runs/bench-corridor runs/bench-corridor-detector runs/bench-corridor-scans

# Learns the reference that .ci/run holds the demo run against; commit it with the change that moves the numbers. Wide
# limits where machines differ: CI runs on whatever there is, beside whatever else runs there.
reference: demo
	$(BIN)/su3d-bench check --build-from runs/demo --out .ci/reference.json --machine-tolerance 5 --cost-limit 3

# Generates the tables of docs/architecture.md from the code.
architecture: $(VENV)/test
	$(BIN)/python tools/docs/architecture.py

# The documentation site, which works from the disk: open build/site/index.html. Under --quiet mkdocs counts no warnings,
# and --strict would end nothing.
docs: $(VENV)/docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

lint: $(VENV)/dev
	$(BIN)/python .ci/check_budget.py
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

$(VENV)/core: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if (3, 11) <= v < (3, 13) else f"Python {v[0]}.{v[1]} found; su3d-bench needs 3.11 or 3.12: make PYTHON=python3.11 ...")'
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) -e .
	@touch $@

$(VENV)/docs: $(VENV)/core
	$(PIP) -e '.[docs]'
	@touch $@

$(VENV)/test: $(VENV)/core
	$(PIP) -e '.[models,sheets,ray,slurm,stores,parquet,rerun,test]'
	@touch $@

$(VENV)/dev: $(VENV)/test
	$(PIP) -e '.[models,sheets,ray,slurm,stores,parquet,rerun,test,dev]'
	@touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
