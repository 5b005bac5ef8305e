# Two commands on a fresh machine with Python >= 3.11 and make:
#   make demo   flies, reconstructs, estimates and scores a synthetic flight; pictures in demo-flight/
#   make test   checks the code and runs the tests (the longest statistics: make long)
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# two processes; threads of linear algebra in each would only get in each other's way
PYTEST := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadscope --no-loadscope-reorder -q

# each command reads byte code then, also where Python is told to write none: a third of a second
COMPILED := $(BIN)/python -m compileall -q flightmodel recon estimators synthetic_flight postflight

.PHONY: demo test fast long lint docs notebooks clean

demo: $(VENV)/installed
	$(BIN)/postflight demo demo-flight

# kernels first: otherwise both processes compile them
test: lint
	$(BIN)/postflight warmup
	$(PYTEST) -m "not long"

# statistics over many flights and second days of whole ones, beyond what a check of every change can wait for
long: $(VENV)/installed-dev
	$(PYTEST) -m long

fast: $(VENV)/installed-dev
	$(PYTEST) -m "not slow and not long"

lint: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# the documentation as a site that needs no network: site/index.html, with a report and the notebooks' output
docs: $(VENV)/installed-docs build/notebooks/made
	$(BIN)/python -m mkdocs build --strict

build/notebooks/made: notebooks/*.ipynb | $(VENV)/installed-docs
	test -d demo-flight || $(BIN)/postflight demo demo-flight
	$(BIN)/python -m nbconvert --to notebook --execute --output-dir build/notebooks notebooks/*.ipynb
	touch $@

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/installed: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --editable .
	$(COMPILED)
	touch $@

$(VENV)/installed-dev: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	$(COMPILED)
	touch $@ $(VENV)/installed

$(VENV)/installed-docs: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --editable '.[docs]'
	touch $@

clean:
	rm -rf $(VENV) demo-flight build dist site
