# The commands of servobench. Each sets up what it needs first: a virtual environment from the
# lock files (every archive checked by its hash), made anew only when a lock file changes.
#
#   make demo        run the example bench on the simulated drive; builds the core first, some seconds
#   make check       format, lint, types, import rules
#   make test        the tests that need no SocketCAN
#   make collect     have pytest read all tests: whoever runs them next finds them compiled
#   make unit        the unit tests of one room, ROOM=drivers, virtual_bus, design or hil
#   make draws       the tests of which make test takes a few drawn cases, with all of them
#   make edits       edit the files of a campaign EDITS times between its runs: no row may rest on another content
#   make stranger    what README, documents, hil init and --help show typed, from a wheel installed in an environment
#                    of its own, in a bare folder: on the oldest Python of this machine (PYTHONS), and README and
#                    hil init on the newest
#   make test-dask   campaigns on a Dask cluster of this machine
#   make test-vcan   the tests on vcan0: native SocketCAN, or inside User Mode Linux
#   make test-can    the tests on two CAN controllers of one bus: CAN0=can0 CAN1=can1, or emulated by QEMU
#                    (CORE=1: without what takes an emulated machine minutes each, but for one run of a bench)
#   make truth       hold the rows of runs against the truth: of given plans, then of drawn ones, for at most
#                    SECONDS each
#   make swarm       hold runs drawn at random against what must be true of each, as a campaign (OUT=DIR: its
#                    folder, in which it goes on), then runs whose processes or disk are struck, and mutated
#                    files against their loaders, for at most SECONDS each
#   make rehearsals  commission simulated drives by made-up data sheets, each with what vendors' sheets lack or
#                    have oddly, alone and in pairs, for at most SECONDS
#   make mistakes    commission drawn drives by nameplates with the mistakes that people make, for at most SECONDS
#   make strangers   put single forged frames on drawn buses, and look for strangers where there are none, for at
#                    most SECONDS
#   make outages     have the adapter of drawn benches take no frames, be down and lose what comes, in simulated time
#                    and on a hub: no false pass, nothing unaccounted, no drive left turning; SECONDS each
#   make attack      certify peaks of drawn loops over lost readings and commands, inertias and delays, and have another
#                    simulation search for more, for at most SECONDS
#   make sheets      have hil eds, hil commission and hil run at each of 40 made-up data sheets, and before them at
#                    vendors' own (SHEETS=FOLDER), on the hub, with a third party that writes every frame down;
#                    for at most SECONDS (1800 unless said), of the made-up ones from FIRST on
#   make mutate      put defects into the product: all in its safety limits and fault reactions, and for at
#                    most SECONDS drawn ones anywhere; the tests must see them
#   make pictures    draw every page of runs of every kind, for at most SECONDS, into build/pictures, and look in
#                    the pixels for what has to be there
#   make exits       end and hold up each process of a run in each of its phases, then have code of the user's end
#                    its command in every way, for at most SECONDS each, then have every command write to streams
#                    that are gone, full or closed
#   make bench       print the benchmarks' figures
#   make instructions  count with valgrind the instructions of a cycle, by owner, and tell the rise against those kept;
#                    status 1 above 3 % (KEEP=1: keep them)
#   make core        build the native core; every target that runs something does it by itself
#   make core-debug  build it with sanitizers: LD_PRELOAD=$(gcc -print-file-name=libasan.so) with what runs it
#   make core-fuzz   a core with sanitizers under drawn frames, drives and misuse, for at most SECONDS
#   make compile     compile what has changed of the hot modules; test and bench do it by themselves
#   make pure        take the compiled modules away (SERVOBENCH_PURE=1 with any command leaves them unused)
#   make wheel       sdist and wheel for this Python, compiled, into dist/
#   make wheels      sdist, and from it a wheel for each of PYTHONS, each tried in an environment with nothing else
#   make docs        the documentation as a site, into build/site; strict: a link that leads nowhere fails
#   make lock        renew the lock files from pyproject.toml (UPGRADE=1: newest versions)
#   make clean       remove the virtual environment and the tools' caches

PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin

PEERS   ?= .venv-bench

# Each Python that is served and that this machine has, the oldest first.
PYTHONS ?= $(shell .ci/pythons)

RUNTIME := $(VENV)/.runtime
TOOLS   := $(VENV)/.tools

export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Tests, swarms and mutants start hundreds of processes: each would compile every module anew.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help setup core core-debug core-fuzz compile pure wheel wheels demo check format test collect unit draws edits stranger test-dask test-vcan test-can truth swarm rehearsals sheets mistakes strangers outages attack mutate pictures exits bench instructions docs lock clean
.DELETE_ON_ERROR:

help:
	@sed -n '1,/^$$/s/^# \{0,1\}//p' Makefile

setup: $(TOOLS)

# The order matters: an old interpreter would fail much later, with a riddle.
$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "servobench needs Python 3.11 or newer; make PYTHON=/path/to/python3.11" >&2; exit 2; }
	@$(PYTHON) -c 'import ensurepip, venv' || { \
	  echo "Python lacks its venv module; on Debian: apt-get install python3-venv" >&2; exit 2; }
	@echo "Setting up $(VENV): once, a minute or two"
	@$(PYTHON) -m venv $(VENV)

CORE := $(foreach room,design virtual_bus hil,$(room)/core/native.abi3.so)

# A machine without a C compiler gets one as a package, for the build only.
$(RUNTIME): requirements.lock pyproject.toml | $(BIN)/python
	@$(BIN)/pip install --quiet --require-hashes -r requirements.lock
	@$(BIN)/python design/core/build.py compiler || \
	  $(BIN)/pip install --quiet --require-hashes -r requirements-compiler.lock
	@$(BIN)/pip install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

$(TOOLS): requirements-dev.lock $(RUNTIME)
	@$(BIN)/pip install --quiet --require-hashes -r requirements-dev.lock
	@touch $@

core: $(CORE)

$(CORE) &: $(wildcard */core/*.[ch]) design/core/build.py | $(RUNTIME)
	@$(BIN)/python design/core/build.py

core-debug: $(RUNTIME)
	@$(BIN)/python design/core/build.py debug

core-fuzz: $(TOOLS) $(CORE)
	@$(BIN)/python -m tests.core_fuzz --seconds $(SECONDS)

# Whether a build is needed is decided by the digests of the sources, not by the ages of files.
compile: $(RUNTIME) $(CORE)
ifndef SERVOBENCH_PURE
	@mkdir -p build
	@$(BIN)/python setup.py --quiet build_ext --inplace 2>build/compile.log || { \
	  cat build/compile.log; echo "The hot modules do not compile; make pure runs them interpreted" >&2; exit 1; }
endif

pure: $(RUNTIME)
	@$(BIN)/python setup.py remove

# The backends of pyproject.toml are in the lock: what is built is built with the versions of this environment.
wheel: $(TOOLS) $(CORE)
	@rm -rf dist && mkdir -p build dist
	@$(BIN)/python -c 'import setuptools.build_meta as backend; backend.build_sdist("dist")' >build/wheel.log 2>&1 \
	  && rm -rf build/wheel && SERVOBENCH_COMPILE=$(if $(SERVOBENCH_PURE),,1) $(BIN)/pip wheel --quiet --no-deps \
	     --no-build-isolation --wheel-dir build/wheel . >>build/wheel.log 2>&1 || { cat build/wheel.log; exit 1; }
	@PATH="$(abspath $(BIN)):$$PATH" auditwheel repair --wheel-dir dist build/wheel/*.whl >>build/wheel.log 2>&1 || { \
	  cp build/wheel/*.whl dist; echo "auditwheel gives it no manylinux tag; see build/wheel.log" >&2; }
	@ls -sh dist

wheels: $(TOOLS)
	@BIN=$(BIN) .ci/wheels $(PYTHONS)

demo: $(RUNTIME) $(CORE)
	@$(BIN)/hil run examples/ling2012.toml
	@test -e drivers/compiled.json || echo "Interpreted; make compile (some minutes, once) makes it several times faster."

check: $(TOOLS)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(TOOLS)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

IGNORED := --ignore=tests/vcan --ignore=tests/can --ignore=tests/dask

# A third process on two cores: the tests in real time, which mostly wait, are in the first and go before the others.
# What is broken everywhere ends early, with its failures shown, not at the limit of each test.
test: $(TOOLS) compile
	$(BIN)/pytest --maxfail=25 --tx popen --tx '2*popen//nice=10' --dist=loadgroup $(IGNORED)

# Behind compile: what is put in place meanwhile cannot be imported.
collect: $(TOOLS) compile
	@$(BIN)/pytest --collect-only --quiet --quiet $(IGNORED) >/dev/null

ROOM ?= $(error which room? make unit ROOM=drivers, virtual_bus, design or hil)

unit: $(TOOLS) $(CORE)
	@$(BIN)/pytest --quiet --numprocesses=2 --dist=loadgroup -m "not long" --durations=5 --durations-min=2 tests/unit/$(ROOM)

draws: $(TOOLS) compile
	@DRAWS=all $(BIN)/pytest --numprocesses=2 --dist=loadgroup $$(grep -rlE --include='test_*.py' '(few|examples)_(of|pairs)\(' tests)

EDITS ?= 1000

edits: $(TOOLS) compile
	@EDITS=$(EDITS) $(BIN)/pytest tests/scenario/test_campaign_identity.py -k no_edit

stranger: $(TOOLS) compile
	@BIN=$(BIN) .ci/stranger $(firstword $(PYTHONS)) $(lastword $(PYTHONS))

test-dask: $(TOOLS) compile
	@$(BIN)/pytest tests/dask

test-vcan: $(TOOLS) compile
	@.ci/test-vcan $(BIN)/pytest -o timeout=300 tests/vcan

test-can: $(TOOLS) compile
	@.ci/test-can $(BIN)/pytest -o timeout=600 $(if $(CORE),-m "not long") tests/can tests/vcan/test_bus_contract.py

SECONDS ?= 300

truth: $(TOOLS) compile
	@$(BIN)/python -m tests.benchmarks.bench_truth --seconds $(SECONDS)
	@$(BIN)/python -m tests.benchmarks.bench_truth_hub --commands nowhere --jitter-us 0 --jitter-us 400 --cycles 5000
	@$(BIN)/python -m tests.truth --seconds $(SECONDS)

swarm: $(TOOLS) compile
	@$(BIN)/python -m servobench.hil.cli campaign tests/swarm/swarm.toml --seconds $(SECONDS) \
	  --resume --out $(or $(OUT),$$(mktemp -d))
	@$(BIN)/python -m tests.swarm --seconds $(SECONDS)
	@$(BIN)/python -m tests.mutants --seconds $(SECONDS)

rehearsals: $(TOOLS) compile
	@$(BIN)/python -m tests.rehearsals --seconds $(SECONDS)

mistakes: $(TOOLS) compile
	@$(BIN)/python -m tests.mistakes --seconds $(SECONDS)

strangers: $(TOOLS) compile
	@$(BIN)/python -m tests.strangers --seconds $(SECONDS)

outages: $(TOOLS) compile
	@$(BIN)/python -m tests.outages --seconds $(SECONDS)
	@$(BIN)/python -m tests.outages --hub --seconds $(SECONDS)

attack: $(TOOLS) compile
	@$(BIN)/python -m tests.attack --seconds $(SECONDS)
	@$(BIN)/python -m tests.attack.uneven examples/controllers/*-uneven.toml

# Vendors' files are not in the repository: where the folder is missing they are left out, and the table says so.
SHEETS ?= ../shared/eds
FIRST ?= 0

sheets: SECONDS = 1800
sheets: $(TOOLS) compile
	@$(BIN)/python -m tests.witness --sheets $(SHEETS) --seconds $(SECONDS) --first $(FIRST)

# Interpreted, in a copy of its own: the checkout and its compiled modules are left alone.
mutate: $(TOOLS) compile
	@$(BIN)/python -m tests.code_mutants --seconds $(SECONDS)

pictures: $(TOOLS) compile
	@$(BIN)/python -m tests.pictures --seconds $(SECONDS)

exits: $(TOOLS) compile
	@$(BIN)/python -m tests.exits --seconds $(SECONDS)
	@$(BIN)/python -m tests.exits.misuse --runs 10000 --seconds $(SECONDS)
	@for kind in pytest hub campaign; do \
	  $(BIN)/python -m tests.exits.elsewhere $$kind --runs 10000 --seconds $(SECONDS) || exit; done
	@STREAMS=0 ENVIRONMENTS=0 $(BIN)/pytest --quiet --numprocesses=2 --dist=load tests/exits/test_streams.py \
	  tests/exits/test_environments.py

# What the benchmarks compare with has an environment of its own, and nothing else needs it.
$(PEERS)/.installed: requirements-bench.lock | $(BIN)/python
	@echo "Setting up $(PEERS): the simulators that the benchmarks compare with"
	@{ $(PYTHON) -m venv $(PEERS) && \
	   $(PEERS)/bin/pip install --quiet --require-hashes -r requirements-bench.lock && touch $@; } || { \
	  rm -rf $(PEERS); echo "They cannot be installed here; the benchmarks go on without them" >&2; }

bench: $(TOOLS) compile $(PEERS)/.installed
	@for name in $(notdir $(basename $(wildcard tests/benchmarks/bench_*.py))); do \
	  echo; echo "python -m tests.benchmarks.$$name"; \
	  SERVOBENCH_PEERS=$(PEERS)/bin/python $(BIN)/python -m tests.benchmarks.$$name || exit; done

instructions: $(TOOLS) compile
	@$(BIN)/python -m tests.benchmarks.instructions $(if $(KEEP),--keep)

docs: $(TOOLS)
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet && echo "written build/site"

# The build backend is in the lock too: the editable install runs without build isolation.
COMPILE = $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes \
          --no-annotate --custom-compile-command "make lock" $(if $(UPGRADE),--upgrade)
BACKEND = import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["build-system"]["requires"], sep="\n")

lock: $(TOOLS)
	$(BIN)/python -c '$(BACKEND)' | $(COMPILE) --extra view --extra design --extra report \
	  -o requirements.lock pyproject.toml -
	$(COMPILE) --group dev -c requirements.lock -o requirements-dev.lock
	$(COMPILE) --group bench -o requirements-bench.lock
	$(COMPILE) --group compiler -o requirements-compiler.lock

clean:
	find design drivers hil virtual_bus -name '*.so' -delete
	rm -f drivers/compiled.json
	rm -rf $(VENV) $(PEERS) build dist ./*.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
