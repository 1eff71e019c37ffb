# `make demo` and `make test` need nothing but Python 3.11+ with venv, and a package index.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test test-slow lint bench clean

demo: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/torch-ssao report heap --technique all --layers 1,4 --size 240x180 --samples 256 --fit-views 0,1 \
		--max-evaluations 60 --out out/demo
	@echo "open out/demo/report.html"

# The README's picture.
docs/demo.png: demo
	cp out/demo/techniques.png $@

# One process a core and one thread a process: small images gain nothing from more.
test: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n auto --maxprocesses 8

test-slow: $(STAMP)
	$(BIN)/python -m pytest -q -m slow

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Every table and figure of docs/statvo.md and docs/stability.md, about an hour; each also runs on its own.
bench: $(STAMP)
	$(BIN)/python -m benchmarks.statvo_precision
	$(BIN)/python -m benchmarks.statvo_speed
	$(BIN)/python -m benchmarks.statvo_claims
	$(BIN)/python -m benchmarks.statvo_surrogate
	$(BIN)/python -m benchmarks.stability

# torch first and pinned, so that no other package pulls a build with gigabytes of CUDA libraries.
$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[all,dev]"
	touch $(STAMP)

clean:
	rm -rf $(VENV) out build dist *.egg-info
