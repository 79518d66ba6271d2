# Each target works alone on a fresh clone: it needs python3 (3.11 or newer) and make, nothing else.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# One stamp for the package with what it needs, and one for the tools of tests and checks too.
INSTALLED := $(VENV)/.installed
INSTALLED_DEV := $(VENV)/.installed-dev

# Some container images set it, and then every process compiles the source of all that it imports, 10 s of PyTorch's.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help demo test test-slow check install install-dev clean

help:  ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /  make \1\t/p' $(MAKEFILE_LIST)

demo: $(INSTALLED)  ## meta-train on built-in circuits, adapt to held-out ones and race there (at most 5 minutes)
	$(BIN)/outlap demo

test: $(INSTALLED_DEV)  ## run the tests (OUTLAP_TRACKS=FOLDER adds those that need real circuits)
	$(BIN)/python -m pytest

test-slow: $(INSTALLED_DEV)  ## run the tests of killed commands and of a Ray cluster (minutes)
	$(BIN)/python -m pytest -m slow -n 1

check: $(INSTALLED_DEV)  ## lint, formatting, spelling, types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell
	$(BIN)/pyright

install: $(INSTALLED)  ## make .venv and install outlap into it

install-dev: $(INSTALLED_DEV)  ## the same with all extras and the tools of tests and checks

clean:  ## remove .venv and what tools left behind
	rm -rf $(VENV) dist build .pytest_cache .ruff_cache .hypothesis
	find src tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +

# Each stamp is made last, so that an install that was cut off is done again.
$(INSTALLED): pyproject.toml constraints.txt | $(BIN)/pip
	@echo "installing outlap and its dependencies into $(VENV): a few minutes the first time" >&2
	$(BIN)/pip install --quiet --no-compile -c constraints.txt -e .
	@touch $@

$(INSTALLED_DEV): pyproject.toml constraints.txt | $(BIN)/pip
	@echo "installing outlap, its extras and its tools into $(VENV): a few minutes the first time" >&2
	$(BIN)/pip install --quiet --no-compile -c constraints.txt -e '.[dev]'
	@touch $(INSTALLED) $@

$(BIN)/pip:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo \
	  "outlap needs Python 3.11 or newer, and $(PYTHON) is older or missing: make PYTHON=/path/to/python3.11 ..." >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); echo \
	  "cannot make a virtual environment: on Debian and Ubuntu, apt install python3-venv" >&2; exit 1; }
