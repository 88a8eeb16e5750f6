# Two commands matter: `make demo` and `make test`. Each sets up .venv on its first run and starts at once afterwards.

VENV := .venv
PY := $(VENV)/bin/python

# The interpreter for .venv: PYTHON=... if given, else the first of these from 3.11 up to the newest with wheels.
CANDIDATES := $(or $(PYTHON),python3 python3.13 python3.12 python3.11 python3.14)
SUITABLE := $(if $(PYTHON),sys.version_info >= (3, 11),(3, 11) <= sys.version_info[:2] <= (3, 14))

# The versions that make installs, for Python 3.11 to 3.13; `make lock` renews them.
CONSTRAINTS := constraints.txt
LOCKED := dev agents demonstrations video bench
UV := uv==0.13.9

# Asked for before the `agents` extra, so that a CPU build of just this version is taken where pip is shown one.
TORCH := torch==2.13.0
WITH_AGENTS := --editable=.[dev,agents,demonstrations,video]
# Trainers of docs/training_loops.md, MIT. SuperSuit's tinyscaler has no wheels for later versions of Python.
TRAINERS := torchrl==0.14.1 'supersuit==3.11.0;python_version<"3.13"'
# LeRobot asks for numpy below 2.3, this project for 2.3 or later, and LeRobot runs with it: pip installs the second over
# the first, and says so.
WITH_LEROBOT := lerobot[dataset]==0.6.1 --editable=.[dev,demonstrations]

# A file's tests run in one worker, which makes what they share once.
PYTEST_ARGS ?= -n 2 --dist loadfile

.PHONY: help demo test test-all test-agents test-agents-all test-lerobot with-lerobot \
    test-newest with-newest test-oldest with-oldest lock with-uv bench soak docs lint dist test-dist committed release clean distclean
.NOTPARALLEL:

help:
	@echo "make demo         press the simulated probe into the liver; results in runs/demo"
	@echo "make test         the tests (PYTEST_ARGS='-n 2 --dist loadfile' is the default)"
	@echo "make test-all     the slow ones too"
	@echo "make test-agents  those that need stable-baselines3 (installs torch); make test-agents-all the slow ones too"
	@echo "make test-lerobot  those that need LeRobot, in $(VENV)-lerobot (Python 3.12 or 3.13; installs 5 GB)"
	@echo "make test-newest  the core's and the environments' with the newest versions that are allowed, in $(VENV)-newest"
	@echo "make test-oldest  the same with the lowest ones, in $(VENV)-oldest (Python 3.11)"
	@echo "make lock         renew $(CONSTRAINTS), the versions that make installs"
	@echo "make bench        time everything beside MuJoCo flex and Newton; writes docs/benchmarks.md"
	@echo "make soak         play all environments for an hour with random, corner and adversarial actions"
	@echo "make docs         the documentation site, in site/; warnings and lost links are errors"
	@echo "make lint         ruff and pyright"
	@echo "make dist         the source archive and the wheel, in dist/"
	@echo "make test-dist    installs the wheel, nothing else, for each Python from 3.11 that is here, and tries it"
	@echo "make release      all of these but bench and soak, slow tests too, and a local tag of the version"
	@echo "make clean        remove what runs, tests and builds left; make distclean removes $(VENV) as well"
	@echo "PYTHON=/path/to/python picks the interpreter (3.11 or newer) that $(VENV) is made from"

demo: $(VENV)/.ready-demo
	$(VENV)/bin/surgsim palpate --scene liver --out runs/demo

# Tests run side by side: threads that wait for their parts of a small matrix cost more than they save.
test test-all test-agents test-agents-all with-newest with-oldest: export OMP_NUM_THREADS := 1
test test-all test-agents test-agents-all with-newest with-oldest: export OPENBLAS_NUM_THREADS := 1

test: $(VENV)/.ready-dev
	$(PY) -m tests.compile_kernels
	$(PY) -m pytest $(PYTEST_ARGS)

test-all: $(VENV)/.ready-dev
	$(PY) -m tests.compile_kernels
	$(PY) -m pytest $(PYTEST_ARGS) -m ""

test-agents: $(VENV)/.ready-agents
	$(PY) -m pytest $(PYTEST_ARGS) -m "agents and not slow"

test-agents-all: $(VENV)/.ready-agents
	$(PY) -m pytest $(PYTEST_ARGS) -m agents

# LeRobot 0.6 in an environment of its own, from Python 3.12 on.
test-lerobot:
	@$(MAKE) --no-print-directory VENV=$(VENV)-lerobot with-lerobot

with-lerobot: CANDIDATES = $(or $(PYTHON),$(PYTHONS))
with-lerobot: SUITABLE = (3, 12) <= sys.version_info[:2] <= (3, 13)
with-lerobot: $(VENV)/.ready-lerobot
	$(PY) -m pytest tests/agents/test_lerobot.py -m lerobot

# Both ends of what pyproject.toml allows. No stamp files: what is newest changes from day to day. numba's cache is apart,
# as one version overwrites what another compiled.
BOUNDS_TESTS := tests/core tests/envs tests/test_unchanged.py
with-newest with-oldest: export NUMBA_CACHE_DIR := $(CURDIR)/$(VENV)/numba_cache

test-newest:
	@$(MAKE) --no-print-directory VENV=$(VENV)-newest with-newest

# numpy and scipy leave Pythons behind sooner than this project does.
with-newest: CANDIDATES = $(or $(PYTHON),python3.13 $${PYENV_ROOT:-$$HOME/.pyenv}/versions/3.13.*/bin/python3 python3.12 python3)
with-newest: $(VENV)/.made
	@echo "surgsim: installing into $(VENV): the newest versions"
	@$(PY) -m pip install -qq --disable-pip-version-check --upgrade --upgrade-strategy eager --editable=.[dev]
	$(PY) -m tests.compile_kernels
	$(PY) -m pytest $(PYTEST_ARGS) $(BOUNDS_TESTS)

test-oldest: with-uv
	@$(VENV)-uv/bin/uv pip compile --quiet --python-version 3.11 --resolution lowest-direct --extra dev \
	    --no-annotate --output-file $(VENV)-uv/oldest.txt pyproject.toml
	@$(MAKE) --no-print-directory VENV=$(VENV)-oldest CONSTRAINTS=$(VENV)-uv/oldest.txt with-oldest

# The lowest versions have wheels for Python 3.11.
with-oldest: CANDIDATES = $(or $(PYTHON),$(PYTHONS))
with-oldest: SUITABLE = sys.version_info[:2] == (3, 11)
with-oldest: $(VENV)/.made
	@echo "surgsim: installing into $(VENV): the lowest versions"
	@$(PY) -m pip install -qq --disable-pip-version-check -c $(CONSTRAINTS) --editable=.[dev]
	$(PY) -m tests.compile_kernels
	$(PY) -m pytest $(PYTEST_ARGS) $(BOUNDS_TESTS)

# torch is pinned above. Without it go what its CUDA build alone asks for.
lock: with-uv
	@echo "$(TORCH)" | $(VENV)-uv/bin/uv pip compile --quiet --universal --python-version 3.11 --only-binary :all: --upgrade \
	    --constraint - $(LOCKED:%=--extra %) --no-header --no-annotate --output-file $(VENV)-uv/lock.txt pyproject.toml
	@{ echo "# What make installs with, renewed by \`make lock\`. The Makefile pins torch and LeRobot."; \
	    grep -vE '^(torch|triton|nvidia-[a-z0-9-]*|cuda-[a-z-]*)==' $(VENV)-uv/lock.txt; } >$(CONSTRAINTS)

with-uv:
	@$(MAKE) -s --no-print-directory VENV=$(VENV)-uv $(VENV)-uv/.made
	@$(VENV)-uv/bin/python -m pip install -qq --disable-pip-version-check $(UV)

bench: $(VENV)/.ready-bench
	$(VENV)/bin/surgsim bench --out docs

soak: $(VENV)/.ready-demo
	$(PY) benchmarks/soak.py --minutes 60

# Material for MkDocs advertises its successor at each build.
docs: $(VENV)/.ready-dev
	NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --strict --quiet
	$(PY) -m pytest -q -m slow tests/docs/test_site.py
	@echo "surgsim: the site is in site/; open site/index.html (searching needs a server: $(PY) -m http.server -d site)"

lint: $(VENV)/.ready-dev
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m pyright --pythonpath $(PY)

VERSION = $(shell sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml)
# Where Pythons are looked for; of each minor version the first is taken.
PYTHONS ?= python3.11 python3.12 python3.13 python3.14 $${PYENV_ROOT:-$$HOME/.pyenv}/versions/*/bin/python3
# ALONE=--all steps every environment; by default the README's code and `surgsim doctor` run.
ALONE ?=

dist: $(VENV)/.ready-dev
	rm -rf dist
	$(PY) -m build --no-isolation --outdir dist . >dist.log 2>&1 || { cat dist.log >&2; exit 1; }
	@rm -f dist.log
	@ls -sh dist

# In folders of their own under dist/, side by side, each with an empty numba cache.
test-dist: dist
	@tried=" "; begun=; for python in $(PYTHONS); do \
	    found=$$("$$python" -c 'import sys; ($(SUITABLE)) and print("python%d.%d" % sys.version_info[:2])' 2>/dev/null); \
	    case " $$tried " in *" $$found "*) continue;; esac; tried="$$tried $$found"; \
	    folder=$(CURDIR)/dist/$$found; \
	    echo "surgsim: the wheel alone, for minutes, in $$folder (see log there)"; \
	    mkdir -p $$folder/work; \
	    { "$$python" -m venv $$folder/env \
	        && $$folder/env/bin/python -m pip install -qq --disable-pip-version-check dist/*.whl \
	        && cd $$folder/work && NUMBA_CACHE_DIR=$$folder/cache \
	            $$folder/env/bin/python $(CURDIR)/tests/packaging/alone.py $(CURDIR)/README.md $(ALONE); } \
	        >$$folder/log 2>&1 & \
	    begun="$$begun $$!:$$folder"; \
	done; \
	[ "$$tried" != " " ] || { echo "surgsim: no Python from 3.11 on among: $(PYTHONS)" >&2; exit 2; }; \
	failed=; for one in $$begun; do wait $${one%%:*} || failed="$$failed $${one#*:}"; cat $${one#*:}/log; done; \
	[ -z "$$failed" ] || { echo "surgsim: failed:$$failed" >&2; exit 1; }

# A tag is of what is committed and tested, and of a version that has none yet.
committed:
	@[ -z "$$(git status --porcelain)" ] || { git status --short; echo "surgsim: that is not committed" >&2; exit 1; }
	@! git rev-parse --quiet --verify "refs/tags/v$(VERSION)" >/dev/null \
	    || { echo "surgsim: v$(VERSION) is tagged already: raise the version in pyproject.toml" >&2; exit 1; }

release: ALONE = --all
release: committed lint docs test-all test-agents-all test-lerobot test-dist
	@$(MAKE) --no-print-directory committed
	git tag -a v$(VERSION) -m "surgsim $(VERSION)"
	@echo "surgsim: tagged v$(VERSION); its notes are in CHANGELOG.md; publish dist/ and the tag by hand"

clean:
	rm -rf runs build dist site .pytest_cache .ruff_cache .hypothesis .numba_cache
	find msdm_core surgsim_env surgsim_apps agents benchmarks docs scenes tests -name __pycache__ -prune -exec rm -rf {} +

distclean: clean
	rm -rf $(VENV) $(VENV)-virtualenv
	rm -rf $(VENV)-lerobot $(VENV)-lerobot-virtualenv $(VENV)-newest $(VENV)-newest-virtualenv
	rm -rf $(VENV)-oldest $(VENV)-oldest-virtualenv $(VENV)-uv $(VENV)-uv-virtualenv

# ---- set-up -------------------------------------------------------------------------------------------------------
# Stamp files, not the folder, say what is done. `.made` holds the folder that .venv was made for; `.installing` lies
# there while pip works. A set-up that was interrupted, or a checkout that has moved, begins again from nothing.

CONSTRAINED = -c $(CONSTRAINTS)
# It asks for versions of its own.
$(VENV)/.ready-lerobot: CONSTRAINED =

define install
@echo "surgsim: installing into $(VENV): $(1)"
@touch $(VENV)/.installing
@for set in $(1); do $(PY) -m pip install -qq --disable-pip-version-check $(CONSTRAINED) $$set || exit 1; done
@rm -f $(VENV)/.installing
@touch $@
endef

$(VENV)/.ready-demo: pyproject.toml $(CONSTRAINTS) $(VENV)/.made
	$(call install,--editable=.)

$(VENV)/.ready-dev: pyproject.toml $(CONSTRAINTS) $(VENV)/.made
	$(call install,--editable=.[dev])
	@touch $(VENV)/.ready-demo

$(VENV)/.ready-agents: pyproject.toml $(CONSTRAINTS) $(VENV)/.made
	$(call install,$(TORCH) $(WITH_AGENTS) $(TRAINERS))
	@touch $(VENV)/.ready-demo $(VENV)/.ready-dev

$(VENV)/.ready-lerobot: pyproject.toml $(VENV)/.made
	$(call install,$(WITH_LEROBOT))

$(VENV)/.ready-bench: pyproject.toml $(CONSTRAINTS) $(VENV)/.made
	$(call install,--editable=.[bench])
	@touch $(VENV)/.ready-demo

ifneq ($(wildcard $(VENV)/.installing),)
.PHONY: $(VENV)/.made
else ifneq ($(shell cat $(VENV)/.made 2>/dev/null),$(CURDIR))
.PHONY: $(VENV)/.made
endif

$(VENV)/.made:
	@found=; for python in $(CANDIDATES); do \
	    if "$$python" -c 'import sys; sys.exit(not ($(SUITABLE)))' >/dev/null 2>&1; then found=$$python; break; fi; \
	done; \
	if [ -z "$$found" ]; then \
	    echo "surgsim: no Python from 3.11 on among: $(CANDIDATES); name one: make PYTHON=/path/to/python ..." >&2; exit 2; \
	fi; \
	rm -rf $(VENV) $(VENV)-virtualenv; \
	echo "surgsim: making $(VENV) with $$("$$found" -V) ($$found)"; \
	if ! "$$found" -m venv $(VENV) >$(VENV).log 2>&1; then \
	    echo "surgsim: $$found -m venv failed (Debian without python3-venv?); using virtualenv instead"; \
	    rm -rf $(VENV); \
	    { "$$found" -m pip install -qq --disable-pip-version-check --target $(VENV)-virtualenv virtualenv \
	        && PYTHONPATH=$(VENV)-virtualenv "$$found" -m virtualenv --quiet $(VENV); } \
	        || { cat $(VENV).log >&2; rm -rf $(VENV) $(VENV)-virtualenv $(VENV).log; exit 1; }; \
	fi; \
	rm -rf $(VENV)-virtualenv $(VENV).log
	@echo "$(CURDIR)" >$@
