# make demo: both stages of ETL on a MyoSuite hand, in a few minutes.
# make test: the whole test suite, in the same environment.
# make docs: the documentation site, into site/; opens with any static server.
# make bench: speed and memory beside their peers, into docs/performance.md; under 25 minutes.
#   ONLY="update end_to_end" runs these parts.
# make smoke: both stages on each of the paper's 13 tasks, for as long as it takes to see them run.

PYTHON ?= python3
# Everything is run from inside the repository, so a path with a space in it is fine.
VENV := .venv
BIN := $(VENV)/bin
# Headless everywhere; one OpenMP thread per process keeps two cores for two processes.
export MPLBACKEND := Agg
export OMP_NUM_THREADS ?= 1

.PHONY: demo test docs bench smoke lint lock clean

demo: $(VENV)/.complete
	$(BIN)/python recipes/etl_sac.py env=myoHandReachFixed-v0 experiment=demo

# Where the site's tools cannot be had, the tests of the site are skipped, with that reason.
test: $(VENV)/.complete lint
	-$(MAKE) --no-print-directory .venv-docs/.complete
	$(BIN)/python -m pytest -n 2 --dist loadfile --durations=25

smoke: $(VENV)/.complete
	set -e; for task in $$($(BIN)/python recipes/list_tasks.py names); do \
	  $(BIN)/python recipes/etl_sac.py env=$$task experiment=smoke progress=false; \
	done

bench: $(VENV)/.complete .venv-peers/.complete
	$(BIN)/python benchmarks/bench.py --write $(if $(ONLY),--only $(ONLY))

# Stable-Baselines3 and SBX live apart: they may want other versions than we do.
.venv-peers/.complete: benchmarks/peers.lock
	$(PYTHON) -m venv .venv-peers
	.venv-peers/bin/python -m pip install --quiet --no-deps -r benchmarks/peers.lock
	touch $@

docs: .venv-docs/.complete
	NO_MKDOCS_2_WARNING=1 .venv-docs/bin/python -m mkdocs build --strict

# The site's tools live apart: they read the source and import none of it.
.venv-docs/.complete: website/requirements.lock
	$(PYTHON) -m venv .venv-docs
	.venv-docs/bin/python -m pip install --quiet --no-deps -r website/requirements.lock
	touch $@

lint: $(VENV)/.complete
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The marker is written last: an installation that broke off is done again.
$(VENV)/.complete: requirements.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet -r requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation -e .
	touch $@

# Pin what is installed now.
lock:
	$(BIN)/python -m pip freeze --exclude-editable --all | grep -v '^pip==' | sed 's/+cpu//' > requirements.lock

clean:
	rm -rf $(VENV) .venv-peers .venv-docs site
