# Two commands for a newcomer: `make demo` and `make test`. Both install what they need into .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed-dev
RENDER := $(VENV)/.installed-render
DOCS := $(VENV)/.installed-docs

.PHONY: demo dist docs faults test lint typecheck clean help

help:  ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/'

# One set of tested versions for everybody: constraints.txt. It names torch by version alone and pip takes the build that it
# finds first; to have another build (for a GPU, or a small one for processors only) install that into .venv first.
$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

# A renderer and a simulator for the tests marked `render` and `miniworld`. Furniture, LLVM, EGL and Mesa are packages of the
# system; README.md names them.
$(RENDER): $(STAMP)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev,render,miniworld]'
	touch $@

# What the site is built with: Sphinx, MyST-NB and the theme.
$(DOCS): $(STAMP)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev,docs]'
	touch $@

demo: $(STAMP)  ## train VUSFA in the bundled bathroom, evaluate it, film one walk
	$(BIN)/python recipes/demo.py

docs: $(DOCS)  ## build the documentation site into docs/_build/html; a warning is an error, tutorials are executed
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html

dist: pyproject.toml  ## build the wheel and the sdist into dist, and check their metadata, contents and sizes
	rm -rf dist build
	$(PYTHON) -m venv $(VENV)-dist
	$(VENV)-dist/bin/python -m pip install --quiet build twine
	$(VENV)-dist/bin/python -m build --outdir dist .
	$(VENV)-dist/bin/python -m twine check --strict dist/*
	.ci/check-dist dist

lint: $(STAMP)  ## ruff: rules and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

typecheck: $(STAMP)  ## mypy
	$(BIN)/mypy

test: lint typecheck $(RENDER)  ## lint, type-check, all tests and doctests
	$(BIN)/python -m pytest -n 2 --dist worksteal -q --durations=25

faults: $(STAMP)  ## the long form of the suites of faults, half an hour; writes docs/reliability.md
	VUSFA_LONG=1 $(BIN)/python -m pytest -q tests/cluster/test_ray_train.py tests/faults/test_torchrun.py
	$(BIN)/python tests/faults/long.py $(FAULTS)

clean:  ## remove the virtual environment and everything built
	rm -rf $(VENV) $(VENV)-dist build dist docs/_build docs/api *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
