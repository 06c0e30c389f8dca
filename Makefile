# Every target does its own set-up (scripts/setup.sh), which takes no time once it's been done.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
.PHONY: help setup demo test test-fast test-mpi lint docs image test-image study clean

# Ranks of `make test-mpi`, and further arguments for pytest: make test PYTEST_ARGS='-k rotation -x'
RANKS ?= 2
PYTEST_ARGS ?=

RUN := . scripts/env.sh &&

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-11s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: ## install the system packages (as root) and the package into .venv
	@scripts/setup.sh

demo: setup ## run the curved cantilever at 1 m cells; writes results/curved_cantilever
	$(RUN) python demos/curved_cantilever.py --cell 1 --output results/curved_cantilever

test: setup ## run all tests
	$(RUN) python -m pytest $(PYTEST_ARGS)

test-fast: setup ## run all tests but the slow verification runs
	$(RUN) python -m pytest -m "not slow" $(PYTEST_ARGS)

test-mpi: setup ## run the fast tests on 2 ranks (RANKS=3: on 3)
	scripts/pytest-on-ranks.sh $(RANKS) $(PYTEST_ARGS)

lint: ## check style and types with ruff and mypy
	@scripts/lint.sh

docs: setup ## build the pages, running their examples; writes docs/_build/html/index.html
	@scripts/install-packages.sh debian-packages-docs.txt
	$(RUN) python -m sphinx -W --keep-going -q -b html docs docs/_build/html

image: ## build the Docker image
	@docker info >/dev/null 2>&1 \
	  || { echo 'image: no Docker engine answers; as root, `make test-image` builds without one' >&2; exit 1; }
	docker build -t polarmpm -f docker/Dockerfile .

test-image: ## build the image without a Docker engine (as root) and run the fast tests in it
	scripts/build-image-without-engine.sh build
	scripts/build-image-without-engine.sh test

study: setup ## compare material points with finite elements: error against time; writes results/mpm_versus_fem
	$(RUN) python benchmarks/mpm_versus_fem.py --output results/mpm_versus_fem

clean: ## remove what was built, installed and cached here (results stay)
	rm -rf docs/_build docs/tutorial docs/gallery docs/sg_execution_times.rst
	rm -rf .venv .venv-lint build .pytest_cache .mypy_cache .ruff_cache src/*.egg-info src/polarmpm/kernels/*.so
	find src tests demos benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +
