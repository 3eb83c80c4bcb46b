# make setup | test [JOBS=n] | test-all [JOBS=n] | wheel | demo [DATA=folder] | docs | notebook | soak | fuzz [COUNT=n] [SEED=n] | lint | format | clean
# BEAGS_VENV names the environment; clones may share one. PYTHON names the interpreter that makes it.
BEAGS_VENV ?= .venv
BIN := $(BEAGS_VENV)/bin
CXX_FILES = $(shell git ls-files --cached --others --exclude-standard '*.cpp' '*.cc' '*.h' '*.hpp' '*.inl' '*.cu')

# With passive waiting, idle OpenMP threads leave the cores to torch's other threads.
export OMP_WAIT_POLICY = PASSIVE

JOBS ?= 2

.PHONY: help setup test test-all wheel demo docs notebook soak fuzz lint format clean

help:
	@sed -n '1,2p' Makefile

# Compares digests kept in the environment with this clone's files; a second run takes no time.
setup:
	@bash scripts/setup_env.sh "$(BEAGS_VENV)"

# Tests of what is not there are skipped, with the reason: CUDA needs a GPU; the viewer in a browser needs Chromium
# (Debian: apt install chromium). Each process has one thread; tests that need more set them.
PYTEST = BEAGS_REQUIRE_NATIVE=1 OMP_NUM_THREADS=1 "$(BIN)/python" -m pytest -q -n $(JOBS) --dist loadscope \
  --no-loadscope-reorder

# Every room, in about four minutes on two idle cores.
test: setup
	$(PYTEST) -m "not slow"

# Those too that must take long: each says why.
test-all: test
	$(PYTEST) -m slow

# An sdist and a wheel in dist/, for computers without a compiler.
wheel: setup
	@bash scripts/build_wheel.sh "$(BEAGS_VENV)" dist

demo: setup
	"$(BIN)/beags" demo $(if $(DATA),--data "$(DATA)")

# The documentation site, in build/docs/site; a warning ends it. Its tools (the extra "docs") are installed when they are
# first needed.
docs: setup
	@"$(BIN)/python" -c 'import mkdocstrings, zensical' 2>/dev/null || \
	  "$(BIN)/python" -m pip --disable-pip-version-check install -qq -c constraints.txt zensical mkdocstrings-python
	"$(BIN)/python" scripts/docs_site.py
	NO_COLOR=1 "$(BIN)/zensical" build --strict --clean

# Runs docs/try_it.ipynb from top to bottom, and keeps its output in it.
notebook: setup
	@"$(BIN)/python" -c 'import ipykernel, nbconvert' 2>/dev/null || \
	  "$(BIN)/python" -m pip --disable-pip-version-check install -qq ipykernel nbconvert
	rm -rf build/notebook && mkdir -p build/notebook && cp docs/try_it.ipynb build/notebook
	PATH="$(abspath $(BIN)):$$PATH" "$(BIN)/python" -m nbconvert --to notebook --execute --inplace build/notebook/try_it.ipynb
	cp build/notebook/try_it.ipynb docs/try_it.ipynb

# Long tests: random scenes and files, runs that are killed, memory over thousands of steps. About an hour.
soak: fuzz
	"$(BIN)/python" tests/soak/fuzz_parsers.py --count 300
	"$(BIN)/python" tests/soak/kill_test.py
	"$(BIN)/python" tests/soak/long_run.py

fuzz: setup
	"$(BIN)/python" tests/soak/fuzz.py --count "$(or $(COUNT),1000)" --seed "$(or $(SEED),0)"

lint: setup
	"$(BIN)/ruff" check .
	"$(BIN)/ruff" format --check .
	"$(BIN)/pyright" --pythonpath "$(BIN)/python"
	$(if $(strip $(CXX_FILES)),"$(BIN)/clang-format" --dry-run --Werror $(CXX_FILES))

format: setup
	"$(BIN)/ruff" check --fix .
	"$(BIN)/ruff" format .
	$(if $(strip $(CXX_FILES)),"$(BIN)/clang-format" -i $(CXX_FILES))

# Leaves the environment (it may be shared), but makes the next setup build again.
clean:
	rm -rf build dist baselines/build .cache .pytest_cache .ruff_cache .hypothesis
	find . -path ./.venv -prune -o -name __pycache__ -type d -exec rm -rf {} +
	rm -f "$(BEAGS_VENV)/.beags-source" "$(BEAGS_VENV)/.beags-joined"
