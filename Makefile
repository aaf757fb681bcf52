# Everything runs in .venv, which is made on first use and brought up to date when pyproject.toml changes.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check

.PHONY: help demo test test-slow bench lint hooks clean

help:
	@echo "make demo       render a self-made scene to demo/ (EXR and PNG)"
	@echo "make test       lint, types and all quick tests"
	@echo "make test-slow  the long tests"
	@echo "make bench      run every script in bench/"
	@echo "make lint       ruff and mypy only"
	@echo "make hooks      let git run the hooks of .githooks/"
	@echo "make clean      remove .venv, caches and demo/"

demo: $(VENV)/.installed
	@$(BIN)/penumbra demo -o demo

test: lint
	$(BIN)/python -m pytest

test-slow: $(VENV)/.installed-test
	$(BIN)/python -m pytest -m slow

bench: $(VENV)/.installed-bench
	@for script in $$(grep -l __main__ bench/*.py); do echo "== $$script"; $(BIN)/python "$$script" || exit 1; done

lint: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

hooks:
	git config core.hooksPath .githooks

clean:
	rm -rf $(VENV) demo .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml | $(BIN)/python
	@echo "Installing penumbra and what it needs into $(VENV) (a minute or two)"
	@$(PIP) --editable .
	@touch $@

$(VENV)/.installed-test: pyproject.toml | $(BIN)/python
	@echo "Installing penumbra and what its tests need into $(VENV) (a minute or two)"
	@$(PIP) --editable ".[test]"
	@touch $@ $(VENV)/.installed

$(VENV)/.installed-bench: pyproject.toml | $(BIN)/python
	@echo "Installing penumbra and what its benchmarks need into $(VENV) (a few minutes)"
	@$(PIP) --editable ".[test,bench]"
	@touch $@ $(VENV)/.installed-test $(VENV)/.installed
