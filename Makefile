# Every target makes its own environment in .venv; PYTHON chooses the interpreter (3.11 or newer).
PYTHON ?= python3
VENV := .venv
STAMP := $(VENV)/.installed

.PHONY: demo demo-train table1 table1-reference ablations gain-curve planning learning scenes test test-slow lint bench docs clean

demo: $(STAMP)
	$(VENV)/bin/python -m persist_cli.reproduce.demo runs/demo

demo-train: $(STAMP)
	$(VENV)/bin/python -m persist_cli.reproduce.demo --train runs/demo-train

table1: $(STAMP)
	$(VENV)/bin/python -m persist_cli.reproduce.table1 runs/table1

table1-reference: $(STAMP)
	$(VENV)/bin/python -m persist_cli.reproduce.table1 runs/table1-reference --reference

ablations: $(STAMP)
	$(VENV)/bin/python -m persist_cli.reproduce.ablations runs/ablations

gain-curve: $(STAMP)
	$(VENV)/bin/python -m persist_cli.reproduce.ablations runs/gain-curve --only paper,improved \
		--samples 1000,2000,5000,10000,20000,50000

planning: $(STAMP)
	$(VENV)/bin/python -m persist_cli.reproduce.planning runs/planning

learning: $(STAMP)
	$(VENV)/bin/python -m persist_cli.reproduce.learning runs/learning

scenes: $(STAMP)
	$(VENV)/bin/python -m persist_cli.reproduce.scenes runs/scenes

# hundreds of processes of the tests import the same modules, whose bytecode is kept for that, whatever the shell says
test test-slow: export PYTHONDONTWRITEBYTECODE :=

# two processes of one thread each take about half the time of one, and each file stays in one process, the longest first
test: $(STAMP) lint
	$(VENV)/bin/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --durations=20 -m "not slow and not gpu"

test-slow: $(STAMP)
	$(VENV)/bin/python -m pytest -m slow

lint: $(STAMP)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/lint-imports

# all benchmarks that run without an argument
bench: $(STAMP)
	for file in $$(grep -L required=True tests/benchmarks/bench_*.py); do $(VENV)/bin/python $$file || exit 1; done

docs: $(VENV)/.docs
	$(VENV)/bin/python -m sphinx --fail-on-warning --keep-going --nitpicky --fresh-env --quiet docs docs/_build
	@echo "look at docs/_build/index.html"

$(VENV)/.docs: $(STAMP)
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[docs]'
	touch $@

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $(STAMP)

# what these targets made and can make again; runs/ holds trainings and memories
clean:
	rm -rf $(VENV) docs/_build .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
