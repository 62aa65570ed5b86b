# Every target makes its own environment in .venv when it is missing or older than what it is made from.
.DELETE_ON_ERROR:
.PHONY: help week test suite robustness lint bench docs studies audit clean
.DEFAULT_GOAL := help

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install -qq --disable-pip-version-check

# One thread a process: the tests and the benchmarks share out the cores themselves.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
export MKL_NUM_THREADS := 1
# Byte code is kept, else every program that a test starts compiles the package anew.
unexport PYTHONDONTWRITEBYTECODE

help:
	@echo "make week     the whole protocol on the simulated cell, with report, into week/"
	@echo "make test     ruff, mypy and every test"
	@echo "make robustness  faults, kills, long runs and run-to-run equality of every command: at most 20 minutes"
	@echo "make lint     ruff and mypy only"
	@echo "make bench    time and memory beside other programs and against size, into docs/benchmarks.md: a quarter of an hour"
	@echo "make docs     the documentation, into docs/_build/html/"
	@echo "make studies  the figures and tables of the paper and the other studies, into studies/output/"
	@echo "make audit    known weaknesses of what is installed, where the network answers"
	@echo "make clean    remove .venv, caches, build products and week/"

week: $(VENV)/.test
	$(BIN)/fpcal week -o week

# Types are checked on one core while the tests begin on the other.
test: $(VENV)/.test
	$(MAKE) --no-print-directory --jobs 2 lint suite

suite: $(VENV)/.test
	$(BIN)/python -m pytest -n 2 --dist worksteal

# Programs that pytest does not collect; they say how many faults they injected.
robustness: $(VENV)/.test
	$(BIN)/python tests/robustness/run_all.py --minutes 20

lint: $(VENV)/.test
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

# A missed target of speed ends a program with status 1; what it measured belongs on the page all the same.
bench: $(VENV)/.bench
	rm -rf .benchmarks
	mkdir -p .benchmarks
	-$(BIN)/python -m pytest benchmarks --benchmark-only --benchmark-columns=min,median,rounds --benchmark-sort=name \
		--benchmark-timer=time.process_time --benchmark-json=.benchmarks/bench.json
	-$(BIN)/python benchmarks/bench_posterior.py --nuts-draws 150 --nuts-warm-up 150 --steps 600 > .benchmarks/posterior.txt
	-$(BIN)/python benchmarks/scaling.py --json .benchmarks/scaling.json
	$(BIN)/python benchmarks/page.py --pytest .benchmarks/bench.json --scaling .benchmarks/scaling.json \
		--posterior .benchmarks/posterior.txt -o docs/benchmarks.md
	@echo "docs/benchmarks.md"

docs: $(VENV)/.test
	$(BIN)/python -m sphinx -W --keep-going -q docs docs/_build/html
	@echo "docs/_build/html/index.html"

studies: $(VENV)/.test
	$(BIN)/python studies/run_all.py

audit: $(VENV)/.test
	-$(PIP) pip-audit
	$(BIN)/python studies/audit.py

clean:
	rm -rf $(VENV) week build dist docs/_build docs/reference/api docs/reference/api.md docs/reference/cli.md studies/output .benchmarks .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/.test: pyproject.toml .python-version
	@python3 -c 'import sys; v = sys.version.split()[0]; sys.exit(0 if sys.version_info >= (3, 12) else "fpcal_bayes needs Python 3.12 or newer as python3, found " + v)'
	python3 -m venv --clear $(VENV)
	$(PIP) -e '.[test]'
	@touch $@

$(VENV)/.bench: $(VENV)/.test
	$(PIP) -e '.[bench]'
	@touch $@
