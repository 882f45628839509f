# Everything a newcomer types. Each verb first makes .venv if it is not there or out of date.
#
#   make train     the quickstart experiment: the whole loop on five robots, a tracking table at the end
#   make play      the published policy, or CKPT=PATH, on five robots side by side
#   make test      all tests            make check     format, lint, types
#   make results   tables and figures of docs/results from the published policy (about 25 minutes on two idle cores)
#   make bench     throughput           make package   sdist and wheel, installed and tried in an empty folder
#   make lowest    all tests with the lowest versions setup.py allows, in an environment of its own (.venv-lowest)
#   make mutants   break the mathematics in 143 places, one at a time: do the tests notice? (about ten minutes)
#   make clean     remove what was built (never logs/)
#
# PYTHON names the interpreter (3.10 to 3.13). CONSTRAINTS= installs the newest allowed packages instead of the tested
# set. PIP_ARGS goes to pip when torch is installed, e.g. an --index-url with CPU-only builds, which are far smaller.

PYTHON ?= python3
VENV ?= .venv
CONSTRAINTS ?= -c constraints.txt
PIP_ARGS ?=
CKPT ?=
TEST_ARGS ?=
RESULT_ENVS ?= 256
SWEEP_ENVS ?= 32

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
INSTALLED := $(VENV)/.installed

.PHONY: setup train play test lowest check results bench mutants package clean help

help:
	@sed -n 's/^# \{0,1\}//p' Makefile

setup: $(INSTALLED)

$(INSTALLED): setup.py constraints.txt
	@echo "Installing into $(VENV) (a few minutes the first time)"
	@$(PYTHON) -m venv $(VENV) || { echo "$(PYTHON) cannot make environments; on Debian: apt install python3-venv" >&2; exit 1; }
	@$(PIP) install $(CONSTRAINTS) $(PIP_ARGS) torch
	@$(PIP) install $(CONSTRAINTS) -e '.[dev]'
	@touch $@

train: $(INSTALLED)
	$(BIN)/python train.py quickstart

play: $(INSTALLED)
	$(BIN)/python play.py $(CKPT)

test: $(INSTALLED)
	$(BIN)/python -m pytest $(TEST_ARGS)

lowest:
	mkdir -p build
	sed -n '/install_requires/,/]/s/ *"\([^">]*\)>=\([^",]*\).*/\1==\2/p' setup.py > build/lowest.txt
	$(MAKE) test VENV=.venv-lowest CONSTRAINTS="-c build/lowest.txt" \
		TEST_ARGS="-W ignore::DeprecationWarning -W ignore::FutureWarning"  # old packages use what new ones deprecate

check: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

POLICY := checkpoints/generalist
RESULTS := docs/results
EVALUATE = $(BIN)/eagle evaluate "EAGLE=$(POLICY).safetensors" --envs $(RESULT_ENVS)
PLOT = $(BIN)/eagle plot
# Policies whose embeddings are compared: make results LATENTS="with=A without=B"
LATENTS ?= $(POLICY).safetensors

results: $(INSTALLED)
	rm -rf $(RESULTS)/joint $(RESULTS)/single $(RESULTS)/standing $(RESULTS)/stopping $(RESULTS)/redrawn $(RESULTS)/upright
	$(EVALUATE) --protocol joint --out $(RESULTS)/joint
	$(EVALUATE) --protocol single --out $(RESULTS)/single
	$(EVALUATE) --protocol standing --out $(RESULTS)/standing
	$(EVALUATE) --protocol standing --resample 4 --out $(RESULTS)/stopping
	$(EVALUATE) --protocol joint --resample 4 --out $(RESULTS)/redrawn
	$(EVALUATE) --protocol upright --resample 4 --out $(RESULTS)/upright
	$(PLOT) estimator $(POLICY).safetensors --envs $(RESULT_ENVS) --out $(RESULTS)
	$(PLOT) robustness $(POLICY).safetensors --envs $(SWEEP_ENVS) --out $(RESULTS)
	$(PLOT) bodies $(POLICY).safetensors --envs $(SWEEP_ENVS) --out $(RESULTS)
	$(PLOT) postures $(POLICY).safetensors --out $(RESULTS)
	$(PLOT) response $(POLICY).safetensors --out $(RESULTS)
	$(PLOT) latents $(LATENTS) --out $(RESULTS)
	$(PLOT) curves root=$(RESULTS)/curves/curves_root.csv --smooth 1 --out $(RESULTS)/curves
	$(BIN)/python play.py $(POLICY).safetensors --viewer none --contact-sheet $(RESULTS)/demo.png
	for robot in h1 g1 t1 n1 adam; do $(BIN)/eagle sim2sim $(POLICY).onnx --robot $$robot || exit 1; done > $(RESULTS)/sim2sim.txt

bench: $(INSTALLED)
	$(BIN)/eagle bench

mutants: $(INSTALLED)
	$(BIN)/python -m tests.mutants

package: $(INSTALLED)
	rm -rf dist build
	$(BIN)/python -m build --no-isolation --outdir dist .
	$(PYTHON) -m venv dist/venv
	dist/venv/bin/python -m pip --quiet install $(CONSTRAINTS) $(PIP_ARGS) torch
	dist/venv/bin/python -m pip --quiet install $(CONSTRAINTS) dist/*.whl
	mkdir dist/empty && cd dist/empty && ../venv/bin/eagle doctor && ../venv/bin/train.py smoke

clean:
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .coverage
