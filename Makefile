# make demo and make test each work alone on a fresh checkout; they need python3 (3.11 or later) and make.

PYTHON ?= $(or $(shell for p in python3 python3.14 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done),python3)
VENV := .venv
BIN := $(VENV)/bin
RUNS := runs/demo
DEMO := constant st1a nmpc

.DEFAULT_GOAL := help
.PHONY: help demo test lint clean

help:
	@echo 'make demo   three controllers on the same fault: a table, a picture, a recording'
	@echo 'make test   the tests (make test ARGS="-m slow" for the long validations)'
	@echo 'make lint   format, lint, types, direction of imports'
	@echo 'make clean  remove the environment and the runs'

demo: $(VENV)/.installed
	@for name in $(DEMO); do \
		$(BIN)/python -m pgexcite run configs/smib/fault_$$name.toml --out $(RUNS)/$$name || exit $$?; \
	done
	@$(BIN)/python -m pgexcite compare $(addprefix $(RUNS)/,$(DEMO)) --out $(RUNS)/compare

test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -n auto $(ARGS)

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

clean:
	rm -rf $(VENV) runs

# uv where it is there, pip otherwise; the stamp appears only when everything is installed.
$(VENV)/.installed: WHAT := .
$(VENV)/.installed-dev: WHAT := .[dev]
$(VENV)/.installed $(VENV)/.installed-dev: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo 'Python 3.11 or later is needed; name it with make PYTHON=...' >&2; exit 1; }
	@if command -v uv >/dev/null 2>&1; then \
		uv venv --quiet --allow-existing --python "$$(command -v $(PYTHON))" $(VENV) && \
		uv pip install --quiet --python $(BIN)/python --editable '$(WHAT)'; \
	else \
		{ $(PYTHON) -m venv $(VENV) || \
			{ echo 'this Python cannot make an environment: install its venv module (python3-venv)' >&2; exit 1; }; } && \
		$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '$(WHAT)'; \
	fi
	@touch $@
