# `make` lists the targets. Packages that they need are installed first, in .venv.
# PYTHON=/path/to/python3.12 chooses the Python; UPGRADE=--upgrade renews the pins;
# QUICK=--quick makes bench-localization short.
BIN := .venv/bin
# Made once by `make test`, for several tests.
DEMO := out/test/demo
BUILT_DOCS := out/test/docs
# For commands beside one that the next step waits for: they take what it leaves of the cores.
BESIDE := nice -n 10
# During the set-up for `make test`, apt installs browser, broker, PostGIS and QGIS.
PROGRAMS := $(if $(filter test,$(MAKECMDGOALS)),--programs)
# Checks run side by side: their threads would compete for the cores.
ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
# Compiled modules are kept: hundreds of processes start faster with them.
unexport PYTHONDONTWRITEBYTECODE
MADE := .venv .pdal .pdal.part.* .qgis out build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis qgis_plugin/tests/.qgis-settings

# Two starts a sensor under other conditions than `textbook`: fifty take half an hour each.
RECORDED = $(BIN)/python bench/localization $(QUICK) --only table --starts 2 --conditions

BENCHES := bench-assignment bench-tiles bench-dataset bench-city bench-mask \
	bench-localization bench-vehicles bench-clocks bench-convert bench-alarm bench-sight

.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help set-up set-up-dev set-up-bench pdal demo live-demo city docs test rules test-qgis lint format types faults live-test soak fuzz test-lowest test-newest bench \
	$(BENCHES) samples wheel plugin-zip release constraints clean

help: ## List the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/\1\t\2/p' Makefile | expand -t 20

set-up: ## Set up .venv for gis-radar itself
	@sh tools/set_up.sh run

set-up-dev: ## Set up .venv for the checks too
	@sh tools/set_up.sh dev $(PROGRAMS)

set-up-bench: set-up-dev ## Set up .venv for bench-localization: Open3D too, 1.5 GB
	@sh tools/set_up.sh bench

pdal: ## Get PDAL for the tests into .pdal, or try again
	@sh tools/get_pdal.sh

demo: set-up ## Run the main job on the sample site; results in out/demo
	$(BIN)/gis-radar demo -o out/demo

live-demo: set-up-dev ## Run the live system on the sample junction until Ctrl-C; files in out/live-demo
	@sh tools/get_mosquitto.sh || true
	-@sh tools/get_maplibre.sh
	$(BIN)/python tools/live_demo.py out/live-demo

city: set-up-dev ## Make a simulated city in out/city: SITES (20), MONTHS (2) drawn from measured minutes
	$(ONE_THREAD) $(BIN)/python tools/simulated_city.py out/city --sites $(or $(SITES),20) --months $(or $(MONTHS),2)

docs: set-up-dev ## Build the documentation in out/docs/html, with the notebooks run
	$(BIN)/python tools/build_docs.py --run-notebooks

# Tests are collected once before, which compiles them: else each worker of pytest would do so.
# The tests in QGIS are one process of four, at nearly normal priority: else they would end last.
# mypy runs beside them, as neither uses the cores all the time.
test: lint ## Run every check: lint, types, tests, the plugin in a real QGIS
	@rm -rf $(DEMO) $(BUILT_DOCS) && mkdir -p $(dir $(DEMO))
	$(ONE_THREAD) $(BIN)/python tools/side_by_side.py \
		'sh -c "$(BIN)/gis-radar demo -o $(DEMO) --json >$(DEMO).jsonl || { tail -n 1 $(DEMO).jsonl; exit 1; }"' \
		'$(BESIDE) $(BIN)/python tools/build_docs.py $(BUILT_DOCS)' \
		'$(BESIDE) sh -c "$(BIN)/pytest --collect-only >$(DEMO).tests || { tail -n 50 $(DEMO).tests; exit 1; }"' \
		'$(BESIDE) sh tools/get_browser_and_qgis.sh'
	GIS_RADAR_DEMO=$(DEMO) GIS_RADAR_DOCS=$(BUILT_DOCS) $(ONE_THREAD) $(BIN)/python tools/side_by_side.py \
		'$(BIN)/pytest -n 3 --dist worksteal' 'nice -n 3 sh tools/test_qgis.sh' 'nice -n 3 $(BIN)/mypy'

faults: set-up-dev ## Run every input kind with every fault; `make test` runs a sample
	GIS_RADAR_FAULTS=all $(ONE_THREAD) $(BIN)/pytest -n 3 --dist worksteal tests/faults tests/fuzz

live-test: set-up-dev ## Run the long tests of the live system and of a city's run, minutes; `make test` runs the short ones
	@sh tools/get_mosquitto.sh
	GIS_RADAR_LIVE=all $(ONE_THREAD) $(BIN)/pytest --durations=10 $(wildcard tests/test_live*.py) \
		tests/test_city_run.py::test_days_in_any_order_without_a_sensor_as_if_it_had_never_been

soak: set-up-dev ## Run 100 simulated sensors for SOAK_MINUTES (15): losses, lateness, memory, CPU
	@sh tools/get_mosquitto.sh
	$(ONE_THREAD) $(BIN)/python bench/live_soak.py --minutes $(or $(SOAK_MINUTES),15) --sensors $(or $(SENSORS),100)

fuzz: set-up-dev ## Search for bytes that make a reader fail, for FUZZ_SECONDS (3600); findings in out/fuzz
	PYTHONPATH=.:tests $(ONE_THREAD) $(BIN)/python -m fuzz

test-lowest: set-up-dev ## Test with the lowest versions that pyproject.toml allows
	@$(ONE_THREAD) sh tools/test_versions.sh lowest

test-newest: set-up-dev ## Test with the newest versions of all packages
	@$(ONE_THREAD) sh tools/test_versions.sh newest

test-qgis: set-up ## Test the plugin in a real QGIS, which is installed on Debian 12
	@sh tools/test_qgis.sh

# Left out are tests that take minutes: build of the documentation, its examples, the report in two languages.
rules: lint ## Check the rules of CONTRIBUTING.md in half a minute; `make test` has the rest of them
	$(ONE_THREAD) $(BIN)/pytest -q $(patsubst %,tests/test_%.py,layers names languages project plugin formats_known docs) \
		-k "not (site_builds or tutorial_runs or docstrings_run or german_report or reports or paper or every_language)"

lint: set-up-dev ## Check style and layout
	$(BIN)/ruff check
	$(BIN)/ruff format --check

format: set-up-dev ## Mend style and layout
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

types: set-up-dev ## Check the types
	$(BIN)/mypy

bench: set-up-bench ## Run every benchmark; print a table of all figures, and those that became worse
	@rm -rf out/bench out/bench-vehicles/bench.json
	-@$(MAKE) --keep-going $(BENCHES)
	$(BIN)/python bench/summary.py

bench-assignment: set-up-dev ## Measure the assignment of points to tiles beside other libraries
	$(BIN)/python bench/assignment.py

bench-tiles: set-up-dev ## Measure a million tiles, made and written
	$(BIN)/python bench/tiles.py

bench-dataset: set-up-dev ## Measure a dataset: time, memory, bytes
	$(BIN)/python bench/dataset.py

bench-city: set-up-dev ## Measure questions over a year, the map of a month, and executors of a run
	$(BIN)/python bench/city_questions.py
	$(ONE_THREAD) $(BIN)/python bench/city_run.py

bench-mask: set-up-dev ## Measure the road mask: time, and memory from few tiles to many
	PATH=.pdal/bin:$$PATH $(BIN)/python bench/mask.py

bench-localization: set-up-bench ## Measure localization beside the paper's method (QUICK=--quick: short)
	$(BIN)/python bench/localization $(QUICK)
	for method in lane icp; do $(RECORDED) "radar as recorded, walkers" --methods $$method || exit 1; done
	$(RECORDED) "drivers as recorded" --methods lane

bench-vehicles: set-up-bench ## Measure vehicles and occupancy beside the true traffic
	$(BIN)/python bench/vehicles

bench-convert: set-up-dev ## Measure the conversion of captures: time, and memory from short to long
	$(BIN)/python bench/convert.py

bench-clocks: set-up-dev ## Measure the errors of clock offsets
	$(BIN)/python bench/clocks.py

bench-alarm: set-up-dev ## Measure how soon a small move is noticed, and false alarms a month
	$(BIN)/python bench/alarm.py

bench-sight: set-up-dev ## Measure sight beside the truth of towns and roads on two levels
	$(BIN)/python bench/sight.py

samples: set-up-dev ## Make the files in sample_maps again
	$(BIN)/python sample_maps/make_samples.py

wheel: set-up-dev ## Build a wheel in dist
	-@sh tools/get_maplibre.sh
	$(BIN)/uv build --wheel --build-constraints constraints.txt --out-dir dist

plugin-zip: wheel ## Build the installable zip of the QGIS plugin in dist
	$(BIN)/python tools/plugin_zip.py --wheel "$$(ls -t dist/gis_radar-*.whl | head -n 1)"

release: plugin-zip docs ## Build all files of a release in dist: wheel, sources, plugin, documentation
	$(BIN)/uv build --sdist --build-constraints constraints.txt --out-dir dist
	$(BIN)/python tools/release.py

constraints: set-up-dev ## Pin what pyproject.toml asks for in constraints.txt
	printf 'hatchling\nuv\n' | $(BIN)/uv pip compile --quiet --no-header --no-annotate \
		--universal --python-version 3.11 --fork-strategy fewest --all-extras --group bench --group dev --group docs \
		$(UPGRADE) --output-file constraints.txt pyproject.toml -

clean: ## Remove all that was made, .venv too
	rm -rf $(MADE)
