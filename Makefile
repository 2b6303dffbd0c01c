# Two commands to start: `make demo` and `make test`. Both make the environment themselves, once.

PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
DEMO   ?= demo

.PHONY: demo test nightly check docs clean

demo: $(READY)
	$(BIN)/crashkit demo -o $(DEMO)

test: $(READY) check
	$(BIN)/python -m pytest -n 2 --dist loadfile

# What takes more than 40 s a test.
nightly: $(READY)
	$(BIN)/python -m pytest -m nightly --timeout 3600

check: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

# Installed again only when what is to be installed has changed.
$(READY): pyproject.toml constraints.txt tools/make_environment.py
	@$(PYTHON) tools/make_environment.py $(VENV)
	@touch $@

docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

clean:
	rm -rf $(VENV) $(DEMO) site
