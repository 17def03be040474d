# `make` lists the targets. Whatever they need is set up first, in .venv.
# PDAL, for the road mask, comes along where it can be had: see tools/get_pdal.sh.
# PYTHON=/path/to/python3.12 chooses the Python; UPGRADE=--upgrade renews the pins.
BIN := .venv/bin
MADE := .venv .pdal .pdal.part.* out build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis

.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help set-up set-up-dev pdal demo test lint format types bench bench-assignment \
	bench-tiles bench-memory bench-truth bench-mask bench-localization samples wheel constraints clean

help: ## List the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/\1\t\2/p' Makefile | expand -t 20

set-up: ## Set up .venv for gis-radar itself
	@sh tools/set_up.sh run
	@sh tools/get_pdal.sh

set-up-dev: ## Set up .venv for the checks too
	@sh tools/set_up.sh dev
	@sh tools/get_pdal.sh

pdal: ## Get PDAL into .pdal, or try again
	@sh tools/get_pdal.sh --again

demo: set-up ## Run the main job on the sample site; results in out/demo
	$(BIN)/gis-radar demo -o out/demo

test: lint types ## Run every check: lint, types, tests
	$(BIN)/pytest -n 2 --dist worksteal

lint: set-up-dev ## Check style and layout
	$(BIN)/ruff check
	$(BIN)/ruff format --check

format: set-up-dev ## Mend style and layout
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

types: set-up-dev ## Check the types
	$(BIN)/mypy

bench: bench-assignment bench-tiles bench-memory bench-truth bench-mask bench-localization ## Run every benchmark

bench-assignment: set-up-dev ## Measure tile assignment against its targets
	$(BIN)/python bench/assignment.py

bench-tiles: set-up-dev ## Measure a million tiles, made and written
	$(BIN)/python bench/tiles.py

bench-memory: set-up-dev ## Measure memory over a recording and one ten times as long
	$(BIN)/python bench/memory.py

bench-truth: set-up-dev ## Compare hit occupancy with the true traffic
	$(BIN)/python bench/truth.py

bench-mask: set-up-dev ## Measure the road mask: time, and memory from few tiles to many
	$(BIN)/python bench/mask.py

bench-localization: set-up-dev ## Measure localization from many starts, no heading given
	$(BIN)/python bench/localization.py

samples: set-up-dev ## Make the files in sample_maps again
	$(BIN)/python sample_maps/make_samples.py

wheel: set-up-dev ## Build a wheel in dist
	$(BIN)/uv build --wheel --build-constraints constraints.txt --out-dir dist

constraints: set-up-dev ## Pin what pyproject.toml asks for in constraints.txt
	printf 'hatchling\nuv\n' | $(BIN)/uv pip compile --quiet --no-header --no-annotate \
		--universal --python-version 3.11 --fork-strategy fewest --all-extras --group dev \
		$(UPGRADE) --output-file constraints.txt pyproject.toml -

clean: ## Remove all that was made, .venv too
	rm -rf $(MADE)
