# Everything happens inside the checkout: `make setup` builds .venv, the other targets use it.

VERSIONS = 3.11 3.12 3.13 3.14
ifndef PYTHON  # the first of these that starts
PYTHON := $(shell for v in $(VERSIONS); do python$$v -c '' 2>/dev/null && { echo python$$v; exit; }; done; echo python3)
endif
UV_VERSION = 0.13.9
VENV = .venv
CORES := $(shell $(PYTHON) -c 'import os; print(len(os.sched_getaffinity(0)))')
WORKERS ?= $(shell expr $(CORES) + 1)
BIN = $(VENV)/bin
UV = .uv/bin/uv

# Whatever the environment says of bytecode: each worker and each program that a test starts imports what is compiled once.
export PYTHONDONTWRITEBYTECODE =
export UV_PROJECT_ENVIRONMENT = $(VENV)

.PHONY: setup demo test quick same check docs pictures site dist bench clean

setup: $(VENV)/.ready

# uv, from PyPI, in an environment of its own, installs what uv.lock says, and leaves alone what the user has installed; where
# $(PYTHON) is newer than any that the libraries have wheels for, it finds or fetches one that is not.
USED = "$$($(PYTHON) -c 'import sys; print(sys.executable if sys.version_info < (3, 15) else "3.13")')"
$(VENV)/.ready: pyproject.toml uv.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "vcmvsp needs Python 3.11 to 3.14: make PYTHON=/path/to/python3.13"; exit 2; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "this Python has no venv module; as root, run .ci/debian-packages"; exit 2; }
	test -x $(UV) || { $(PYTHON) -m venv .uv && .uv/bin/python -m pip install --quiet --disable-pip-version-check uv==$(UV_VERSION); }
	@$(UV) sync --frozen --inexact --quiet --python $(USED) || \
	$(UV) sync --frozen --inexact --quiet --python $(USED) --system-certs  # behind a proxy with certificates of its own
	@$(BIN)/vcmvsp reference --json-schema > scenarios/scenario.schema.json  # which editors find by the first line of a scenario
	@touch $@

demo: setup
	$(BIN)/vcmvsp demo

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy --num-workers auto || { test $$? = 2 && $(BIN)/mypy; }  # 2: its workers did not start within 3 s
	$(BIN)/lint-imports
	$(BIN)/python -m vcmvsp.cosim.reference.markdown

docs: setup
	$(BIN)/python -m vcmvsp.cosim.reference.markdown --write
	$(BIN)/python -m tests.support.docs.package_map --write
	$(BIN)/python -m tests.support.docs.reference_pages --write

# The pictures of the documents, by runs of the scenarios and a browser.
pictures: setup
	$(BIN)/python -m tests.support.docs.pictures

# The documents as pages in site/, from all Markdown of the repository: the same folders, so that links need no change.
SHOWN = '*.md' '*.png' CITATION.cff examples ':!tests' ':!paper'
site: setup
	rm -rf .site site && mkdir .site && git ls-files -co --exclude-standard -- $(SHOWN) | tar -cT - | tar -xC .site
	$(BIN)/zensical build --strict --clean

# Files go to workers in their order, so that none that takes long comes last.
test: check
	$(BIN)/pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder

# Without tests that start programs, open sockets, drive a browser or compute for seconds. None waits: a worker per core.
quick: setup
	$(BIN)/pytest -n $(CORES) -m "not processes and not sockets and not browser and not slow"

# Short runs on another Python give the same bytes: sums as in the file EXPECTED.
same: setup
	$(BIN)/python -m tests.support.smoke | diff - $(EXPECTED)
	$(BIN)/pytest tests/cosim/test_testing.py

# Wheel and source archive in dist/, with metadata that an index accepts.
dist: setup
	rm -rf dist
	$(UV) build --quiet
	$(UV) run --quiet --isolated --no-project --with twine==7.0.0 twine check --strict dist/*

bench: setup .ns3/.ready .drones/.ready .crazyflow/.ready .peers/.ready .sionna/.ready
	$(BIN)/python -m bench

# ns-3, with which the radio is compared, from PyPI; its programs are compiled with g++. Of what cannot be installed, here and
# below, the table says so.
.ns3/.ready: $(VENV)/.ready
	-$(UV) venv --quiet --allow-existing .ns3 && $(UV) pip install --quiet --no-deps --python .ns3/bin/python ns3==3.44.post0 && touch $@

# PyFlyt, and the fork of gym-pybullet-drones that is on PyPI, with which the quadrotors are compared; they want a NumPy of their
# own. The fork names its own Bullet and a library for learning, of which it needs none to fly.
.drones/.ready: $(VENV)/.ready Makefile
	-$(UV) venv --quiet --allow-existing --python $(BIN)/python .drones && \
	$(UV) pip install --quiet --python .drones/bin/python pyflyt==0.29.0 pybullet==3.2.7 numpy==1.26.4 && \
	$(UV) pip install --quiet --python .drones/bin/python transforms3d==0.4.2 pillow==13.0.0 matplotlib==3.10.9 setuptools==80.10.2 && \
	$(UV) pip install --quiet --python .drones/bin/python --no-deps swarm-drone-gym==2.0.0.3 && touch $@

# crazyflow, with which the quadrotors are compared, too.
.crazyflow/.ready: $(VENV)/.ready Makefile
	-$(UV) venv --quiet --allow-existing --python $(BIN)/python .crazyflow && \
	$(UV) pip install --quiet --python .crazyflow/bin/python crazyflow==0.4.0 jax==0.10.1 jaxlib==0.10.1 mujoco==4.0.0 mujoco-mjx==3.17.0 flax==0.12.8 && touch $@

# HELICS and mosaik, with which distributed agents are compared, and gradysim, with which messages are, without what it needs to
# talk to autopilots.
.peers/.ready: $(VENV)/.ready Makefile
	-$(UV) venv --quiet --allow-existing --python $(BIN)/python .peers && \
	$(UV) pip install --quiet --python .peers/bin/python helics==3.6.1 mosaik==3.6.0 && \
	$(UV) pip install --quiet --python .peers/bin/python --no-deps gradysim==0.8.2 && touch $@

# Sionna RT, with which rays are compared. Its compiler is Debian's libllvm19 (older ones do not know all processors).
.sionna/.ready: $(VENV)/.ready Makefile
	-$(UV) venv --quiet --allow-existing --python $(BIN)/python .sionna && \
	$(UV) pip install --quiet --python .sionna/bin/python sionna-rt==2.2.0 mitsuba==3.9.1 drjit==1.5.0 && touch $@

clean:
	rm -rf .venv .venv-* .uv .ns3 .drones .crazyflow .peers .sionna runs dist .site site .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
