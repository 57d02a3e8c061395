# `make demo` and `make test` set everything up themselves; a second call installs nothing.
# PYTHON chooses the interpreter, PIP_ARGS goes to pip (an index of your own: PIP_ARGS='--index-url ...').
PYTHON ?= python3
PIP_ARGS ?=
BIN := .venv/bin
READY := .venv/.ready

.PHONY: demo test test-long bench clean

demo: $(READY)
	$(BIN)/waybayes experiment=demo

test: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 -m "not slow"

test-long: $(READY)
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 -m slow || [ $$? -eq 5 ] # 5: no slow test is left

bench: $(READY)
	$(BIN)/python -m benchmarks.intersection

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "waybayes needs Python 3.11 or newer, but '$(PYTHON)' is $$($(PYTHON) --version 2>&1); choose one with PYTHON=python3.11" >&2; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install $(PIP_ARGS) -c constraints.txt -e '.[test]'
	@touch $@

clean:
	rm -rf .venv .compiled .mypy_cache .pytest_cache .ruff_cache
