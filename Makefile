# `make demo` and `make test` set everything up first and skip what is done. Needs git, Python 3.12 and nothing else.
# Arguments of the command and of pytest: make demo ARGS="seed=1", make test ARGS="-k savi".

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory

VENV := .venv
BIN := $(VENV)/bin
UV := $(BIN)/uv
UV_VERSION := 0.13.8
STAMP := $(VENV)/.setup-done
LOCK := requirements.lock
PLUGIN := lerobot_policy_playslot
ARGS ?=
# Of everything at once; empty: as it is imported.
BYTECODE := --compile-bytecode
# The quick tests compute; whole commands wait for processes, locks and pipes, too: one worker more than cores.
CORES := $(shell getconf _NPROCESSORS_ONLN)
PARALLEL := --maxprocesses 5 --dist loadfile --no-loadscope-reorder
PYTHON ?=

# Where it is set, every test process would compile the tests and the library anew.
unexport PYTHONDONTWRITEBYTECODE
export UV_PYTHON := $(BIN)/python
export UV_PYTHON_DOWNLOADS := never
export PIP_DISABLE_PIP_VERSION_CHECK := 1

# A .venv of another Python, or one moved here with its folder, is made anew.
VENV_OK := $(shell $(BIN)/python -c 'import sys; sys.exit(sys.version_info[:2] != (3, 12))' 2>/dev/null \
	&& grep -qsF '$(CURDIR)/$(VENV)' $(VENV)/pyvenv.cfg && echo yes)

define FIND_PYTHON
for candidate in $(PYTHON) python3.12 python3 python; do
	if "$$candidate" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 12))' 2>/dev/null; then
		echo "$$candidate"
		exit 0
	fi
done
echo "error: found no Python 3.12 (tried: $(PYTHON) python3.12 python3 python)." \
	"Install it, or name one: make setup PYTHON=/path/to/python3.12" >&2
exit 1
endef
export FIND_PYTHON

.PHONY: help setup demo test test-integration test-most test-all test-browser test-gpu docs tables animation notebook lint format typing lock \
	clean FORCE

help:
	@echo "make demo      set up, then the main job: success in simulation and in imagination, in minutes"
	@echo "make test      set up, then the quick tests"
	@echo "make test-integration  whole commands, trainings, simulators, pages, processes, builds: minutes"
	@echo "make test-all  all tests but those in a browser"
	@echo "make test-browser  the page of playslot play in headless Chromium (Debian, Ubuntu: apt-get install chromium)"
	@echo "make test-gpu  training steps on a GPU: captured ones against written ones"
	@echo "make docs      the site of README, docs/ and the API, in build/site"
	@echo "make tables    the tables and plots of README and docs/, from results/*.json"
	@echo "make animation  the README's pictures and the shipped episodes, from the shipped models"
	@echo "make notebook  run examples/quickstart.ipynb and store what it shows"
	@echo "make lint      ruff, format check, mypy strict"
	@echo "make setup     .venv with the pinned packages and $(BIN)/playslot"
	@echo "make format    format the code"
	@echo "make lock      renew the pins in $(LOCK)"
	@echo "make clean     remove .venv, caches and builds; runs and data stay"

setup: $(STAMP)
	@echo "set up: $(BIN)/playslot"

$(UV): $(if $(VENV_OK),,FORCE)
	@python="$$(bash -c "$$FIND_PYTHON")"; \
	if ! "$$python" -c 'import ensurepip, venv' 2>/dev/null; then \
		echo "error: $$python has no venv module. Install it (Debian, Ubuntu: apt-get install python3.12-venv)" >&2; \
		exit 1; \
	fi; \
	if [ -z "$(VENV_OK)" ]; then "$$python" -m venv --clear $(VENV); fi
	@$(BIN)/python -m pip install --quiet "uv==$(UV_VERSION)"

$(STAMP): $(UV) $(LOCK) pyproject.toml $(PLUGIN)/pyproject.toml
	@# With bytecode: where PYTHONDONTWRITEBYTECODE is set, every command would compile torch and its like anew (20 s).
	@$(UV) pip install $(BYTECODE) --require-hashes -r $(LOCK)
	@$(UV) pip install --no-deps --editable . --editable ./$(PLUGIN)
	@touch $@

demo: $(STAMP)
	@$(BIN)/playslot demo $(ARGS)

test: $(STAMP)
	@$(BIN)/python -m pytest -m "not integration and not slow and not browser and not gpu" -n $(CORES) $(PARALLEL) $(ARGS)

test-integration: $(STAMP)
	@$(BIN)/python -m pytest -m "integration and not slow and not browser and not gpu" -n $$(($(CORES) + 1)) $(PARALLEL) $(ARGS)

# Both at once, as .ci/run takes them: workers that wait for processes leave the cores to the quick ones.
test-most: $(STAMP)
	@$(BIN)/python -m pytest -m "not slow and not browser and not gpu" -n $$(($(CORES) + 1)) $(PARALLEL) $(ARGS)

# The slow ones kill processes and count on time: one after the other.
test-all: test test-integration
	@$(BIN)/python -m pytest -m "slow and not browser and not gpu" $(ARGS)

# Playwright (161 MB) is installed here only. The browser is the system's: Playwright's own need not be downloaded.
test-browser: $(STAMP)
	@if ! command -v chromium >/dev/null && ! command -v chromium-browser >/dev/null \
		&& ! command -v google-chrome >/dev/null; then \
		echo "error: found no Chromium. Install it (Debian, Ubuntu: apt-get install --no-install-recommends chromium)" >&2; \
		exit 1; \
	fi
	@$(UV) pip install --quiet -r pyproject.toml --extra browser
	@$(BIN)/python -m pytest -m browser $(ARGS)

# On a machine with a GPU.
test-gpu: $(STAMP)
	@$(BIN)/python -m pytest tests/gpu -m gpu $(ARGS)

lint: $(STAMP) typing
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy

format: $(STAMP)
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

# Of the source alone: nothing is imported, nothing fetched. Not --quiet: --strict counts the warnings that it silences.
docs: export NO_MKDOCS_2_WARNING := 1
docs: $(STAMP) typing
	@$(BIN)/mkdocs build --strict $(ARGS)
	@echo "look at it: $(BIN)/python -m http.server --bind 127.0.0.1 --directory build/site 8000"

tables: $(STAMP)
	@$(BIN)/python docs/_site/tables.py
	@$(BIN)/python docs/_site/pictures.py

animation: $(STAMP)
	@$(BIN)/python docs/_site/animation.py

notebook: $(STAMP)
	@$(BIN)/python docs/_site/notebook.py

# mypy, mkdocs and editors do not know the mapped folders: links that look like the installed package.
typing:
	@mkdir -p .typing/playslot_rl
	@find .typing/playslot_rl -xtype l -delete
	@for entry in playslot_rl/*; do \
		case "$$entry" in */__pycache__) ;; *) ln -sfn "../../$$entry" .typing/playslot_rl/ ;; esac; \
	done
	@for folder in envs collectors recipes; do ln -sfn "../../$$folder" .typing/playslot_rl/; done

lock: $(UV)
	@$(UV) pip compile pyproject.toml --extra dev --extra play --upgrade --generate-hashes --python-version 3.12 --quiet \
		--no-header --no-annotate --no-emit-index-url --no-emit-find-links --output-file $(LOCK)
	@echo "renewed $(LOCK); make setup installs it"

clean:
	@rm -rf $(VENV) build dist *.egg-info $(PLUGIN)/build $(PLUGIN)/src/*.egg-info .pytest_cache .mypy_cache .ruff_cache
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +
