# Two commands on a fresh machine with Python >= 3.11 and make:
#   make demo   flies, reconstructs, estimates and scores a synthetic flight; pictures in demo-flight/
#   make test   checks the code and runs the tests (the longest statistics: make long)
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# two processes; threads of linear algebra in each would only get in each other's way
ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
PYTEST := $(ONE_THREAD) $(BIN)/python -m pytest -n 2 --dist loadscope --no-loadscope-reorder -q

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

# the documentation as a site that needs no network: site/index.html, with a report and the notebooks' output;
# kernels first, as above; then the demo's flight and the notebooks that need none are made side by side
docs: $(VENV)/installed-docs
	$(BIN)/postflight warmup
	$(MAKE) --no-print-directory --jobs 2 demo-flight/demo.png $(NOTEBOOKS)
	$(BIN)/python -m mkdocs build --strict

NOTEBOOKS := $(addprefix build/,$(wildcard notebooks/*.ipynb))
OF_THE_DEMO := $(addprefix build/notebooks/,deflection_by_video.ipynb one_flight.ipynb three_methods_one_answer.ipynb)

demo-flight/demo.png: | $(VENV)/installed-docs
	$(ONE_THREAD) $(BIN)/postflight demo demo-flight

$(OF_THE_DEMO): | demo-flight/demo.png

build/notebooks/%.ipynb: notebooks/%.ipynb | $(VENV)/installed-docs
	$(ONE_THREAD) $(BIN)/python -m nbconvert --to notebook --execute --output-dir build/notebooks $<

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
