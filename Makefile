# relpos: every target prepares what it needs, and nothing is installed twice.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help
# Stamps are folder-wide state: two recipes at once would install into one environment.
.NOTPARALLEL:
# Where bytecode is not kept, each of the processes that tests start compiles its imports anew.
unexport PYTHONDONTWRITEBYTECODE

VENV := .venv
PYTHON := $(VENV)/bin/python
# A stamp stands for what pip put into .venv, and goes with it.
MADE := $(VENV)/.relpos-made
RUN := $(VENV)/.relpos-run
DEVELOP := $(VENV)/.relpos-develop
FUZZ := $(VENV)/.relpos-fuzz
# An environment of their own, lest the peers' bounds change ours. particles 0.4 wants numpy below 2.
BENCH_VENV := .venv-bench
PEERS := $(BENCH_VENV)/.relpos-bench

PIP := $(PYTHON) -m pip --disable-pip-version-check install --progress-bar on
# Part of the installation, so that no first start, and no test, waits for it.
compile-kernels = @printf '%s\n' 'compiling the estimators, once'; \
	$(PYTHON) -c 'from relpos import fusion; [fusion.warm_up(n) for n in fusion.SETTINGS]'
# Where .venv was moved or copied, or its Python replaced, its scripts lead elsewhere: it is made anew.
made-by = $(PYTHON) -c 'import sys; print(sys.prefix, *sys.version_info[:2])'
ifneq ($(wildcard $(MADE)),)
ifneq ($(shell $(made-by) 2>&1),$(shell cat $(MADE)))
.PHONY: $(MADE)
endif
endif
# What both boards' firmware is made of; PlatformIO takes three seconds to see that nothing changed.
FIRMWARE := platformio.ini tools/pio $(shell find firmware tools/platformio tools/*.py -type f -not -name '*.pyc')
BOARDS := .build/pio/.relpos-boards
title = @printf '\n\033[1m== %s\033[0m\n' "$(1)"
define build-boards
$(call title,Firmware for both boards and both sensors)
tools/pio run -e uno -e megaatmega2560 -e uno_mpu9250 -e megaatmega2560_mpu9250
@touch $(BOARDS)
endef

.PHONY: help setup demo live test lint coverage bench bench-chain bench-teams firmware docs pages wire clean bare-root soak fuzz \
        mutants system-demo system-avr system-browser system-soak firmware-tests board-builds python-tests

help: ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(DEVELOP) ## everything Python in .venv; the command is then .venv/bin/relpos

demo: $(RUN) | system-demo ## six emulated nodes through a serial port into the fusion: in a building, then on the level
	$(VENV)/bin/relpos demo --scenario building --out out/demo-building
	$(VENV)/bin/relpos demo --out out/demo

live: $(RUN) | system-demo ## the same team in real time behind the live page; LIVE="--seconds 600 --nodes 20"
	$(VENV)/bin/relpos demo --view --seconds 1800 --out out/live $(LIVE)

test: $(BOARDS) python-tests ## every check: the C++ suites, lint and wire-check are tests among the others

lint: $(DEVELOP) ## ruff, its formatter, mypy
	$(call title,Lint: ruff)
	$(VENV)/bin/ruff check
	$(call title,Lint: ruff format)
	$(VENV)/bin/ruff format --check
	$(call title,Lint: mypy)
	$(VENV)/bin/mypy

wire: $(DEVELOP) ## regenerate the wire's C++ and its page from host/relpos/protocol/messages.py
	$(PYTHON) protocol/generate.py

.PHONY: wire-check
wire-check: $(DEVELOP)
	$(call title,Wire: the generated files are those of host/relpos/protocol/messages.py)
	$(PYTHON) protocol/generate.py --check

firmware-tests: $(DEVELOP) | system-avr ## the C++ suites alone: here, under sanitizers, on the simulated Uno
	tools/pio test -e native -e native_sanitized -e uno_sim

board-builds: $(DEVELOP) | system-avr
	$(build-boards)

$(BOARDS): $(FIRMWARE) $(DEVELOP) | system-avr
	$(build-boards)

coverage: board-builds | system-browser ## share of lines that tests reach: firmware/lib, host/relpos
	$(call title,Firmware suites on this computer, line by line)
	rm -rf .build/pio/build/native_coverage
	tools/pio test -e native_coverage
	$(VENV)/bin/gcovr --filter firmware/lib/ --exclude firmware/lib/board/arduino/ \
		--fail-under-line 90 .build/pio/build/native_coverage
	$(call title,Python tests, line by line)
	OPENBLAS_NUM_THREADS=1 $(VENV)/bin/pytest -n auto --dist loadfile --no-loadscope-reorder --cov --cov-report=term:skip-covered

# Last, so that its closing line is the last of `make test`.
# One BLAS thread a worker: more of them than cores only wait for each other.
python-tests: $(DEVELOP) | system-avr system-browser
	$(call title,Python tests)
	@# In a new clone, compile the tests once: workers that begin together would each do it.
	@[ -d tests/__pycache__ ] || $(VENV)/bin/pytest --collect-only -qq >/dev/null
	OPENBLAS_NUM_THREADS=1 $(VENV)/bin/pytest -n auto --dist loadfile --no-loadscope-reorder --durations 10

soak: board-builds $(FUZZ) | system-soak ## whatever takes long: an hour, then HOURS=0.5 of random faults
	$(call title,Long runs)
	OPENBLAS_NUM_THREADS=1 $(VENV)/bin/pytest -n auto --dist worksteal -m soak -rP
	$(call title,The whole system under random faults)
	$(PYTHON) tests/soak/soak.py --hours $(or $(HOURS),0.5)

mutants: $(DEVELOP) ## small faults in trusted code, which a test has to notice; COUNT=20 of each room
	$(PYTHON) tests/mutants/mutants.py --count $(or $(COUNT),20)

fuzz: $(FUZZ) | system-soak ## every parser of foreign bytes, guided by coverage; MINUTES=5 for each
	$(call title,Fuzzing)
	$(PYTHON) tests/fuzz/parser_fuzzer.py --minutes $(or $(MINUTES),5)

firmware: board-builds ## both boards and sensors: flash, RAM, cycles, beside Mahony and Madgwick
	$(call title,Budget: cycles and stack on simavr)
	$(PYTHON) bench/avr_budget.py --seconds 100 --filters

bench: $(PEERS) ## relpos beside filterpy, Stone Soup, particles, pfilter, GTSAM; BENCH=--quick or --full
	$(call title,Relpos and its peers on the same measurements)
	NUMBA_CACHE_DIR=$(BENCH_VENV)/numba $(BENCH_VENV)/bin/python bench/peers/compare.py $(BENCH) --out out/bench

bench-chain: board-builds ## how fast boards and teams are emulated, and the particle filter through its interface
	@for file in bench/bench_*.py; do echo "== $$file"; $(PYTHON) "$$file"; done

bench-teams: board-builds ## teams of real walkers, from the recordings in RELPOS_DATA (half an hour)
	$(PYTHON) bench/recorded_teams.py --seconds 300 --seeds 3

docs: $(DEVELOP) ## the documentation as a site, in out/docs
	$(call title,Documentation)
	$(PYTHON) tests/architecture/draw_rooms.py
	$(PYTHON) -m sphinx -W --keep-going -q -b html -d .build/docs docs out/docs
	@echo 'open out/docs/index.html'

pages: wire ## regenerate the pages that come from the sources
	$(PYTHON) bench/reliability.py
	$(PYTHON) bench/hardware.py

bare-root: ## as root: README's commands in a bare Debian, SUITE=trixie RUN="demo test"
	tools/bare_root.sh $(or $(SUITE),trixie) $(or $(RUN),demo test)

clean: ## remove what was built; .venv stays
	rm -rf .build .pio out build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis

$(MADE): | system-demo
	$(call title,Setting up .venv)
	"$$(tools/find_python.sh)" -m venv $(if $(wildcard $(MADE)),--clear )$(VENV)
	@$(made-by) >$@

$(RUN): pyproject.toml $(MADE)
	$(call title,Installing relpos and its libraries)
	$(PIP) --editable '.[view,recording,report]'
	$(compile-kernels)
	@touch $@

$(DEVELOP): pyproject.toml $(MADE)
	$(call title,Installing the tools for tests and firmware)
	$(PIP) --editable '.[all,docs,test,lint,firmware]'
	$(compile-kernels)
	@touch $@ $(RUN)

$(FUZZ): $(DEVELOP)
	$(call title,Installing what long runs need: a fuzzer, Rerun, a parser of TAK)
	$(PIP) --editable '.[fuzz,rerun]' takproto
	@touch $@

$(PEERS): pyproject.toml | system-demo
	$(call title,Installing relpos and its peers in $(BENCH_VENV))
	[ -x $(BENCH_VENV)/bin/python ] || "$$(tools/find_python.sh)" -m venv $(BENCH_VENV)
	$(BENCH_VENV)/bin/python -m pip --disable-pip-version-check install --progress-bar on --editable '.[bench,report]'
	@touch $@

system-demo:
	@tools/system_packages.sh demo

system-soak:
	@tools/system_packages.sh soak

system-browser:
	@tools/system_packages.sh browser

system-avr:
	@tools/system_packages.sh avr
