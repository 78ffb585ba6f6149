# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
#
# make fly     set up what is needed, fly the default scenario     make fly SCENARIO=... ARGS="--duration 10"
# make test    set up what is needed, run all checks and tests
# make test-fast   the quick tests without ROS, for the inner loop
# make test-sitl   fly a real autopilot in software: docs/autopilots.md
# make docs   write the site of docs/ to site/; make docs ARGS=serve shows it while it is written
# make pictures   draw the pictures of docs/ again from today's code     make pictures ARGS="report.png"
# make pages   run every block of the tutorials as it stands, half an hour     make pages ARGS=landing
# make mutants   change the law, the guard, verdicts, certificate, fence and bridge in many places: each change must fail a test
# make evidence   measure what has no file in docs/evidence/, write docs/evidence.md     make evidence ARGS="--again speed"
# make source-proof   Frama-C and cppcheck on the exported C code; skipped where they are not installed
# make foxglove   what `rise-di watch --foxglove` needs
# make autopilot   what `rise-di import` and maps over MAVLink need
# make messages PACKAGE=... SOURCE=...   build a message package of an autopilot for the stack: docs/autopilots.md
# make wheel   build dist/rise_di-VERSION-py3-none-any.whl and its sources, which pip installs
# make setup   what flying and its report need: .venv/, the workspace built, .venv/bin/rise-di; make setup-all: campaigns and tests too

PYTHON ?= python3
SCENARIO ?= osprey_servo
UV_VERSION := 0.13.8
# The exit status of a flight in real time on a host that became too busy, which rise-di fly has said: docs/outcomes.md.
HOST := 7
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c

BIN := $(CURDIR)/.venv/bin
PACKAGES := $(notdir $(patsubst %/package.xml,%,$(wildcard ros_ws/src/*/package.xml)))
# With symlinks in place only these need another build; Python sources are live.
BUILD_INPUTS := $(wildcard ros_ws/src/*/package.xml ros_ws/src/*/setup.* ros_ws/src/*/*/scenarios/*.yaml ros_ws/src/*/launch/*.py)

# The venv and the workspace hold the path of their checkout: after a move or a copy everything is made again.
MADE_IN := $(shell sed -n 's/^command = .* -m venv --clear //p' .venv/pyvenv.cfg 2> /dev/null)
MOVED := $(if $(filter-out $(subst $() ,?,$(CURDIR)/.venv),$(subst $() ,?,$(MADE_IN))),yes)

FLY := --extra ros --group build
ALL := $(FLY) --extra campaign --extra autopilot --extra tools --group messages --group docs --group dev
# uv holds every package to the version and the hashes of the lock.
INSTALL := $(BIN)/uv pip install --quiet --compile-bytecode --python $(BIN)/python --constraint requirements.lock --requirement pyproject.toml

XDIST = $(BIN)/python -m pytest --maxprocesses 4 --dist loadfile

ifdef MOVED
.PHONY: .venv/.uv .venv/.fly .venv/.messages .venv/.all .venv/.workspace
endif

.PHONY: fly test test-fast test-sitl mutants check lint docs pictures pages evidence source-proof foxglove autopilot messages wheel setup setup-all lock clean

fly: setup
	@$(BIN)/rise-di fly $(SCENARIO) $(ARGS) || { status=$$?; [ $$status -eq $(HOST) ] || exit $$status; }

# The workers fill the processors: threads of OpenBLAS would only wait for each other.
test test-fast: export OPENBLAS_NUM_THREADS = 1

# pytest keeps the rewritten assertions of each file: else every worker rewrites all of them, a third of what collecting takes.
test test-fast: export PYTHONDONTWRITEBYTECODE =

# Files of tests/ros come first. They wait more than they compute: there is a worker more than processors, and mypy runs beside them.
# Those that fly in real time and measure it come last, by themselves.
test: $(if $(ARGS),setup-all,lint)
	@$(if $(ARGS),$(BIN)/python -m pytest $(ARGS),status=0; types=$$(mktemp); $(BIN)/mypy > $$types 2>&1 & checking=$$!; \
	  trap "kill $$checking 2> /dev/null; rm -f $$types; exit 130" INT; \
	  $(XDIST) -n $$(($$(nproc) + 1)) --no-loadscope-reorder -m "not alone" tests/ros tests/nodes tests/docs tests/fuzz tests/pure || status=$$?; \
	  wait $$checking || status=$$?; cat $$types; rm -f $$types; \
	  $(BIN)/python -m pytest -m alone tests/ros || status=$$?; exit $$status)

test-fast: .venv/.all .venv/.workspace
	@$(XDIST) -n auto --quiet -m "not slow" tests/pure

test-sitl: setup-all
	$(BIN)/python -m pytest tests/sitl -m "not long" $(ARGS)

# The packages of [tool.mutmut] in pyproject.toml.
MUTATED := autopilot_bridge flight_analysis flight_guidance rise_di_controller

mutants: setup-all
	@rm -rf build/mutants && mkdir -p build/mutants
	@cp -r $(foreach package,$(MUTATED),ros_ws/src/$(package)/$(package)) benchmarks docs examples tests pyproject.toml build/mutants
	cd build/mutants && OPENBLAS_NUM_THREADS=1 $(BIN)/mutmut run $(ARGS) && { $(BIN)/mutmut results | grep ": survived" || echo "no change survived"; }

foxglove autopilot: setup
	$(INSTALL) --extra $@

check: lint
	$(BIN)/mypy

lint: setup-all
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

docs: setup-all
	$(BIN)/python -m tools.parameters
	$(BIN)/python -m tools.topics
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs $(or $(ARGS),build --quiet)

pictures: setup-all
	@$(BIN)/python -m benchmarks.pictures $(ARGS)

pages: setup-all
	@$(BIN)/python -m benchmarks.pages $(ARGS)

evidence: setup-all
	@$(BIN)/python -m benchmarks.evidence $(ARGS)

source-proof: setup-all
	@$(BIN)/python -m tools.source_proof $(ARGS)

messages: .venv/.messages
	@$(if $(and $(PACKAGE),$(SOURCE)),,echo "error: say make messages PACKAGE=px4_msgs SOURCE=FOLDER" >&2; exit 2)
	@$(BIN)/python -m tools.messages $(PACKAGE) $(SOURCE) $(if $(MESSAGES),--messages $(MESSAGES)) $(ARGS)

wheel: .venv/.fly
	@rm -rf dist
	$(BIN)/uv build --quiet --no-build-isolation --python $(BIN)/python --out-dir dist

setup: .venv/.workspace

setup-all: .venv/.all .venv/.workspace

.venv/.uv:
	@command -v $(PYTHON) > /dev/null || { echo "error: no $(PYTHON) here; install Python 3.11 to 3.13, or say make PYTHON=..." >&2; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' \
	  || { echo "error: $$($(PYTHON) --version) found, but the ROS 2 wheels are for 3.11 to 3.13; say make PYTHON=python3.12" >&2; exit 2; }
	@$(if $(MOVED),echo "this checkout was made in $(MADE_IN): everything is made again in $(CURDIR)" >&2)
	$(PYTHON) -m venv --clear .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes --requirement .ci/uv.txt
	@touch $@

.venv/.fly: requirements.lock | .venv/.uv
	$(INSTALL) $(FLY)
	@touch $@

.venv/.messages: requirements.lock | .venv/.fly
	$(INSTALL) --group messages
	@touch $@

.venv/.all: requirements.lock | .venv/.uv
	$(INSTALL) $(ALL)
	@touch .venv/.fly .venv/.messages $@

.venv/.workspace: $(BUILD_INPUTS) | .venv/.fly
	@$(if $(MOVED),rm -rf ros_ws/build ros_ws/install ros_ws/log)
	@mkdir -p ros_ws/build ros_ws/install && find ros_ws/build ros_ws/install -xtype l -delete # colcon keeps links to files that moved, and fails
	cd ros_ws && PATH="$(BIN):$$PATH" colcon build --symlink-install --event-handlers console_cohesion- status-
	@printf '%s\n' 'import sys, _signal; sys.orig_argv[1:2] and sys.orig_argv[1].endswith("/rise-di") and _signal.signal(_signal.SIGINT, _signal.SIG_DFL)' \
	  $(PACKAGES:%=$(CURDIR)/ros_ws/build/%) `# first a quiet Ctrl-C while rise-di loads` \
	  > "$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/rise_di_workspace.pth"
	@ln -sf ../../ros_ws/install/flight_cli/lib/flight_cli/rise-di .venv/bin/rise-di
	@$(BIN)/python -m compileall -q ros_ws/src # also where PYTHONDONTWRITEBYTECODE is set: each process starts 0.15 s earlier
	@touch $@

lock: | .venv/.uv
	$(BIN)/uv pip compile --quiet --upgrade $(LOCK)

LOCK := pyproject.toml $(ALL) --extra foxglove --universal --python-version 3.11 --generate-hashes --no-annotate --no-emit-index-url \
  --custom-compile-command "make lock" --output-file requirements.lock

clean:
	rm -rf .venv dist ros_ws/build ros_ws/install ros_ws/log
