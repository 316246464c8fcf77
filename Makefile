# `make` alone lists what there is.
# Every target makes .venv first where it is missing, and again where what it installs changed.

VENV := .venv
PYTHON ?= python3.12 python3.11 python3

.DEFAULT_GOAL := help
.PHONY: help demo figures docs test check test-all clean
.DELETE_ON_ERROR:

help: ## this list
	@sed -n 's/^\([a-z-]*\):.*## /  make \1\t/p' Makefile | expand -t 18
	@echo "  PYTHON=/path/to/python3.12 names the interpreter .venv is made with (3.11 or 3.12)."

demo: $(VENV)/installed ## robots, fusion and recorder as processes, then the report
	$(VENV)/bin/multi_robot_slam demo

figures: $(VENV)/installed ## the paper's experiments into runs/figures, 20 repeats; goes on if interrupted
	$(VENV)/bin/multi_robot_slam study experiment all --repeats 20 --out runs/figures

docs: $(VENV)/installed ## the documentation as a site, build/docs/index.html; a warning is an error
	$(VENV)/bin/python -m sphinx -q -W --keep-going -d build/doctrees docs build/docs

test: $(VENV)/installed ## the tests
	$(VENV)/bin/python -m pytest -n auto --maxprocesses 8 --dist loadfile

check: $(VENV)/installed ## style, import rules, types, tests: what must pass before a commit
	$(VENV)/bin/ruff check
	$(VENV)/bin/ruff format --check
	$(VENV)/bin/lint-imports
	$(VENV)/bin/mypy
	$(MAKE) test

test-all: check ## check, then the tests with the other supported Python, where it is found
	@used=$$($(VENV)/bin/python -c 'import sys; print(sys.version_info.minor)'); \
	other=3.$$((23 - used)); \
	if python=$$(scripts/find_python python$$other \
	        "$$(pyenv root 2>/dev/null)"/versions/$$other.*/bin/python 2>/dev/null); then \
	    $(MAKE) test VENV=.venv-$$other PYTHON="$$python"; \
	else \
	    echo "No Python $$other found: tested with 3.$$used only."; \
	fi

clean: ## removes virtual environments, caches and build folders; results in runs/ stay
	rm -rf .venv .venv-* build install log *.egg-info .pytest_cache .ruff_cache .hypothesis .import_linter_cache .mypy_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Editable, so that the code runs from here. No ':' in the path: it separates search paths.
$(VENV)/installed: setup.cfg setup.py pyproject.toml
	@case "$(CURDIR)" in *:*) echo "$(CURDIR): move the checkout to a path without ':'" >&2; exit 1;; esac
	@python=$$(scripts/find_python $(VENV)/bin/python 2>/dev/null || scripts/find_python $(PYTHON)) || exit 1; \
	echo "Installing into $(VENV) with $$($$python --version): some 600 MB and two minutes the first time"; \
	[ "$$python" = $(VENV)/bin/python ] || "$$python" -m venv --clear $(VENV)
	$(VENV)/bin/python -m pip install --disable-pip-version-check --editable '.[ros,test]'
	@touch $@
