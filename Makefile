# make demo   set up, then generate, train, clear tables and write demo/report.html
# make test   lint, types and the quick tests; make test-slow: those that take long
# make test-pages  every command of the pages in docs at small scale (half an hour)
# make bench  the figures of docs/benchmarks.md (hours on 2 idle cores)
# make mutants, fuzz, faults; push-figures, grasp-figures, clear-figures  the counts and figures of pages (hours)
PYTHON ?= python3
JOBS ?= 2
BIN := .venv/bin
PYTEST = $(BIN)/python -m pytest -n $(JOBS) --dist loadfile
INSTALL := $(BIN)/pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt -e

.PHONY: setup demo test test-slow test-pages lint bench mutants fuzz faults push-figures grasp-figures clear-figures
help: ; @sed -n 's/^# make/make/p' Makefile

setup: .venv/.installed
.venv/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(INSTALL) '.[dev]'
	touch $@

test: setup lint ; $(PYTEST) -m "not slow and not pages"
test-slow: setup ; $(PYTEST) -m slow
test-pages: setup ; $(PYTEST) -m pages
lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: setup
	$(INSTALL) '.[dev,bench]'
	$(BIN)/python -m benchmarks all --scale full --out benchmarks.json

# the commands of each: python -m experiments.NAME --list; interrupted, the same target continues
demo: setup ; $(BIN)/python -m experiments.demo
push-figures: setup ; $(BIN)/python -m experiments.push_prediction
grasp-figures: setup ; $(BIN)/python -m experiments.grasping
clear-figures: setup ; $(BIN)/python -m experiments.clearing
mutants: setup ; $(INSTALL) '.[dev,mutants]' && $(BIN)/python -m experiments.mutants
fuzz: setup ; $(BIN)/python -m experiments.fuzz
faults: setup ; $(BIN)/python -m experiments.faults
