# `make help` lists the targets. Everything runs in .venv, which the first target builds by itself.
.DEFAULT_GOAL := help
SHELL := /bin/bash
PYTHON ?= python3
BIN := .venv/bin
export OMP_NUM_THREADS := 1
export MKL_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1

.PHONY: help run test test-all test-oldest lint smoke bench docs dist report reproduce-table pack format clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F':.*## ' '{printf "  make %-16s %s\n", $$1, $$2}'

.venv/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

# Compilers and emulators of small controllers are Debian's; the tests that need one that is missing are skipped.
CONTROLLERS := cppcheck gcc-avr avr-libc simavr gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm \
    gcc-riscv64-unknown-elf qemu-system-misc

# Dask and a browser: for the tests of launcher=dask and of the page alone. The browser is
# the machine's Chromium or Chrome, else Playwright's, else the distribution's.
.venv/.installed-all: .venv/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test-all]'
	command -v chromium chromium-browser google-chrome > /dev/null || $(BIN)/playwright install chromium \
	    || apt-get install --yes --quiet chromium
	apt-get install --yes --quiet --no-install-recommends $(CONTROLLERS) || echo "without: $(CONTROLLERS)"
	@touch $@

# Below results/local, so that it leaves the repository's own results alone.
run: .venv/.installed  ## search, map, prune and evaluate a depth-6 policy for Hopper in minutes
	$(BIN)/otr-run env=hopper depth=6 budget=quick algo=ars results_dir=results/local $(ARGS)

# A file's tests run in one process, so that what a file sets up is made once.
test: .venv/.installed  ## the tests (six minutes on two threads of one core)
	$(BIN)/python -m pytest -n 2 --dist loadfile $(ARGS)

test-all: .venv/.installed-all  ## the tests, with more random examples, and the slow ones
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "slow or not slow" --hypothesis-profile=thorough $(ARGS)

# Torch stays the one of constraints.txt, as its oldest comes with an old CUDA; so do the tools of the tests. Gymnasium's
# oldest Box2D has to be compiled, and the library's tests do without.
OLDEST := .venv-oldest/bin
test-oldest:  ## the library's tests, with the oldest packages that pyproject.toml allows
	$(PYTHON) -m venv --clear .venv-oldest
	$(OLDEST)/python -m pip install --quiet --disable-pip-version-check uv
	grep -E '^(torch|hypothesis|blark|onnxruntime|pytest|pytest-xdist)==' constraints.txt > $(OLDEST)/tools.txt
	echo 'box2d-py; python_version < "3"' | $(OLDEST)/uv pip install --quiet --python $(OLDEST)/python \
	    --resolution lowest-direct --overrides /dev/stdin $(UV_ARGS) -r $(OLDEST)/tools.txt -e '.[run,onnx]'
	$(OLDEST)/python -m pytest -n 2 --dist loadfile tests/core tests/geometry tests/importers tests/learners \
	    tests/programs tests/proof tests/shorten $(ARGS)

lint: .venv/.installed  ## ruff, mypy and the direction of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: .venv/.installed  ## let ruff put the code in form
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

smoke: .venv/.installed  ## every environment, every control experiment and every learner, in seconds each
	rm -rf results/smoke
	for file in conf/experiment/*.yaml; do \
	    $(BIN)/otr-run +experiment=$$(basename $$file .yaml) budget=smoke seed=0 launcher=joblib results_dir=results/smoke \
	    || exit 1; done
	$(BIN)/otr-fit +experiment=smoke launcher=joblib results_dir=results/smoke
	$(BIN)/otr-tabulate 4.1 4.2 4.6 4.7 runs fits budget=smoke results_dir=results/smoke > /dev/null

.venv/.installed-docs: .venv/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	@touch $@

docs: .venv/.installed-docs  ## the documentation as a site, in site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	$(BIN)/otr-report gallery=site/gallery/pages
	$(BIN)/otr-tabulate curves run=results/runs out=site/curves.csv > /dev/null

# Nothing but numpy and scipy is there: the library's example runs, and a command says which extra it needs.
DIST := .venv-dist/bin
dist:  ## wheel and sdist in dist/, checked, and installed in an empty environment
	rm -rf dist
	$(PYTHON) -m venv --clear .venv-dist
	$(DIST)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt build twine
	$(DIST)/python -m build --outdir dist
	$(DIST)/twine check --strict dist/*
	for file in dist/*; do \
	    $(PYTHON) -m venv --clear .venv-dist && \
	    $(DIST)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt $$file && \
	    (cd .venv-dist && bin/python -c "import doctest, otr; assert doctest.testmod(otr) == (0, 5)") && \
	    ($(DIST)/otr-run env=pendulum 2>&1 || true) | grep "pip install 'otr\[run\]'" || exit 1; done

bench: .venv/.installed  ## measure against numpy, torch and Stable-Baselines3; writes results/benchmarks
	$(BIN)/python -m benchmarks $(ARGS)

report: .venv/.installed  ## results/page.html: the tables, the figures and the policies, to look at
	$(BIN)/otr-report $(ARGS)

# EVALUATE=1 plays the episodes of the committed policies again and compares; TRAIN=1 trains everything from nothing.
reproduce-table: .venv/.installed  ## the thesis's tables and figures from the runs under results (EVALUATE=1, TRAIN=1)
ifdef TRAIN
	$(BIN)/otr-fit +experiment=table_4_2 launcher=joblib results_dir=results/local
	$(BIN)/otr-fit +experiment=sparse results_dir=results/local
	$(BIN)/otr-tabulate table=4.2 results_dir=results/local
	$(BIN)/otr-run +experiment=table_4_1 results_dir=results/local $(ARGS)
	$(BIN)/otr-tabulate table=4.1 results_dir=results/local
else
	$(BIN)/otr-tabulate all $(if $(EVALUATE),evaluate=true) $(ARGS)
endif

pack: .venv/.installed  ## pack the runs and fits under results, an archive each, to commit them
	$(BIN)/python -m pipelines.cli.pack results

clean:  ## remove the virtual environment and caches; results stay
	rm -rf .venv .venv-oldest .venv-dist dist site .mypy_cache .ruff_cache .pytest_cache .hypothesis
