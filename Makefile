# `make demo` and `make test` are all that a new checkout needs; both make .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
WORKERS ?= $(shell $(PYTHON) -c "import os; print(os.cpu_count() or 1)")

.PHONY: demo test long lint benchmark clean

demo: $(VENV)/.installed
	$(BIN)/mapek reproduce table1

test: $(VENV)/.tests-installed lint
	$(BIN)/python -m pytest -n $(WORKERS) -m "not long"

long: $(VENV)/.tests-installed
	$(BIN)/python -m pytest -n $(WORKERS) -m long

lint: $(VENV)/.tests-installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

benchmark: $(VENV)/.tests-installed
	$(BIN)/python -m pytest tests/benchmarks -p no:randomly --benchmark-enable --benchmark-group-by=group --benchmark-columns=median,min,rounds -s

$(VENV)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "mapek needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) --version). Name another: make PYTHON=python3.12"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

$(VENV)/.tests-installed: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[test]"
	@touch $@

clean:
	rm -rf $(VENV) .hypothesis .mypy_cache .ruff_cache build dist
