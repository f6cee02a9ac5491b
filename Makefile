# make demo     13 plates with a hole → one outside their range, with checks and a picture, in demo/
# make drag     a car with 10 % less drag, confirmed by OpenFOAM: a quarter of an hour on two cores, in demo/openfoam/
# make test     everything that has to hold: lint, types, docs, tests (PYTEST="-m 'not slow'" leaves out the long ones)
# make docs     docs/_build/html/index.html
# make lint     ruff and mypy
#
# All that is needed beforehand: Python 3.11 with pip, and make. The rest goes into .venv, once.

PYTHON ?= $(or $(shell command -v python3.11),python3)
PYTEST ?=
DRAG ?=
PIPFLAGS ?=
BIN := .venv/bin
READY := .venv/ready

# Bytecode is kept, though containers are often told to keep none: tests start hundreds of processes.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo drag test docs lint setup clean

demo: $(READY)
	$(BIN)/python examples/demo.py demo

# A file a core, one thread each: threads of several tests on the same cores wait for each other.
# Files in their order: by the number of their tests the few long ones (examples) would come last, alone.
test: $(READY)
	$(MAKE) --no-print-directory -j 2 lint docs
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder tests examples/third_party_decoder $(PYTEST)

drag: $(READY)
	@command -v simpleFoam >/dev/null || command -v foamRun >/dev/null || { \
	    echo "make drag needs OpenFOAM, with simpleFoam on the PATH: apt-get install openfoam (Debian, Ubuntu)" >&2; exit 2; }
	$(BIN)/python examples/drag/drag.py demo/openfoam $(DRAG)

docs: $(READY)
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs docs/_build/html

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

setup: $(READY)

# pip 23 builds each editable with its own -e; constraints.txt keeps torch at the version without CUDA packages.
$(READY): pyproject.toml constraints.txt examples/third_party_decoder/pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install $(PIPFLAGS) -c constraints.txt setuptools -e ".[dev,docs,aero,dask,openfoam,openmdao]" -e examples/third_party_decoder
	touch $@

clean:
	rm -rf .venv build demo docs/_build .mypy_cache .pytest_cache .ruff_cache .hypothesis
