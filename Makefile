# The commands of the house; .ci/run calls the same ones.

SHELL := /bin/bash
BIN := .venv/bin
ARGS ?=
BUDGET ?= laptop
SCRIPTS := .ci/browser .ci/install .ci/mutate .ci/run .ci/wheel $(shell find docker slurm studio -name "*.sh" -o -name "*.sbatch" 2>/dev/null)

# make takes name=value for a variable of its own and drops what it does not know.
KNOWN := ARGS BUDGET
GIVEN := $(foreach name,$(.VARIABLES),$(if $(filter command,$(origin $(name))),$(name)))
STRAY := $(sort $(filter-out $(KNOWN),$(GIVEN)))
ifneq ($(STRAY),)
$(error make knows no $(firstword $(STRAY))=...: settings go into ARGS="...", as in make train ARGS="seed=1 tokens=parallelogram"; BUDGET=... is for make paper)
endif

# Processes start sooner where Python keeps what it compiled, and the tests start many. Python compiles
# what it imports; pip would compile all, for half a minute. By pip's rule 0 switches that off.
unexport PYTHONDONTWRITEBYTECODE
export PIP_NO_COMPILE := 0

.DEFAULT_GOAL := help
.PHONY: help train studio test check mutation wheel lint settings format paper evidence bench docs lock sbom clean

help:  ## list these commands
	@sed -nE 's/^([a-z]+):.*## (.*)/  make \1\t\2/p' Makefile | expand -t 16

train: .venv/.installed-run  ## train an agent on this machine; settings go into ARGS="seed=1 tokens=parallelogram"
	@$(BIN)/tangram-train $(ARGS)

# Ends with pytest's own summary line. Three tests at a time, on two cores too: those of real processes wait a lot.
PYTEST := OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses=3 --dist=loadgroup
test: lint .venv/.installed-browser  ## lint, then the tests, a short training through real processes included
	@$(PYTEST) $(ARGS)

check: lint .venv/.installed-browser  ## lint, then the tests that are too long for make test
	@$(PYTEST) -m check $(ARGS)

mutation: .venv/.installed-dev  ## change master, worker or game in one place at a time: does a test turn red? ARGS="master/record/journal.py"
	@.ci/mutate $(ARGS)

wheel:  ## install the last commit's wheel with pip for each Python here, train with it: 10 minutes, 7 GB. ARGS="python3.12"
	@.ci/wheel $(ARGS)

lint: .venv/.installed-dev  ## ruff, mypy, import-linter, hadolint and shellcheck; changes nothing
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo
	$(BIN)/hadolint docker/Dockerfile
	$(BIN)/shellcheck $(SCRIPTS)

settings: .venv/.installed-run  ## write docs/settings.md from the declarations of the settings
	@$(BIN)/python -m conf.settings

format: .venv/.installed-dev  ## sort and lay out the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

studio: .venv/.installed-studio  ## a page to play on; settings go into ARGS="port=8080"
	@$(BIN)/tangram-studio $(ARGS)

paper: .venv/.installed-run  ## all figures and tables of the paper: BUDGET=smoke, laptop or paper
	@$(BIN)/tangram-experiment budget=$(BUDGET) $(ARGS)
	@$(BIN)/tangram-report runs=runs/experiments/$(BUDGET)

# Given again, it goes on; what has its rows in docs/results is not made again: what conf/studies.yaml has may be deleted and made anew.
study = $(BIN)/tangram-experiment study=$(1) budget=$(2) seeds=10 run_dir=runs/evidence out=docs/results $(ARGS)
evidence: .venv/.installed-dev  ## what README and docs show of trainings and docs/results lacks: all of it takes a day
	@$(call study,paper,paper)
	@$(call study,token,laptop)
	@$(call study,parts,laptop)
	@$(call study,game,laptop)
	@$(call study,pictures,laptop)
	@$(call study,hand,laptop)
	@$(BIN)/tangram-report runs=docs/results
	@$(BIN)/tangram-report check

bench: .venv/.installed-dev  ## measure speed against what else one could do; options go into ARGS="runs=9"
	@$(BIN)/tangram-bench all out=docs/results/bench.json $(ARGS)

# Not --quiet: mkdocs then counts no warnings, and --strict lets all pass.
docs: .venv/.installed-docs  ## make a site of README and docs, in site/
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "the front page is site/index.html; with search: python3 -m http.server -d site"

lock:  ## write lock.txt and constraints.txt anew, from constraints.txt and pyproject.toml
	@[ -x $(BIN)/uv ] || .ci/install .venv dev
	@$(BIN)/python .ci/lock.py

sbom: .venv/.installed-dev  ## list what is installed in sbom.json (CycloneDX)
	@$(BIN)/cyclonedx-py environment --pyproject pyproject.toml --short-PURLs --output-file sbom.json $(BIN)/python
	@echo "all packages of $(BIN), with versions and licences: sbom.json"

clean:  ## remove caches and build products; .venv and runs/ stay
	rm -rf build dist site *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache sbom.json
	find . -name .venv -prune -o -name __pycache__ -type d -exec rm -rf {} +

# A stamp is older than these files only when something new may be needed.
.venv/.installed-run: pyproject.toml lock.txt
	@.ci/install .venv
	@touch $@

.venv/.installed-docs: pyproject.toml lock.txt
	@.ci/install .venv docs
	@touch .venv/.installed-run $@

.venv/.installed-studio: pyproject.toml lock.txt
	@.ci/install .venv studio
	@touch .venv/.installed-run $@

.venv/.installed-dev: pyproject.toml lock.txt
	@.ci/install .venv dev,docs,onnx,peers,studio,video
	@touch .venv/.installed-run .venv/.installed-docs .venv/.installed-studio $@

.venv/.installed-browser: .venv/.installed-dev
	@.ci/browser
	@touch $@
