# Everything a newcomer needs: make demo, make test. Requires Python 3.11+ and pip; all else goes into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.installed
OUT ?= out/quick
unexport PYTHONDONTWRITEBYTECODE  # containers set it; each of the many processes would compile all that it imports

.PHONY: demo test lint validate install references outside accuracy regression picture curves soak stability clean
.DEFAULT_GOAL := help

.PHONY: help
help:
	@echo "make demo      capture, reconstruct and relight scenes/quick.toml; see $(OUT)/report.html, relight in $(OUT)/view.html"
	@echo "make test      the tests, on every core (minutes)"
	@echo "make lint      style, types, import rules"
	@echo "make validate  the slow tests as well: the figures that quick must reach, among them"
	@echo "make references  render the reference images of quick and of the accuracy set that are missing (hours)"
	@echo "make outside   render the outside references that are missing, by stock Mitsuba (most of an hour of one core)"
	@echo "make accuracy  the default beside all baselines on objects that nothing was chosen on (most of an hour)"
	@echo "make regression  the pipeline of now beside its stored scores, on three frozen captures (minutes)"
	@echo "make soak      20,000 images with faults, kills and resumes: nothing grows, every image is right (minutes)"
	@echo "make curves    error against seconds of the light's estimators: docs/benchmarks/walk.svg (minutes)"
	@echo "make stability the stress suite of all numerical kernels: docs/stability.md (minutes)"
	@echo "make picture   the README's picture, from the demo's run"

install: $(READY)

$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "disco-twin needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) -V). Remedy: make PYTHON=python3.12 ..."; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -e '.[dev]'  # most is never imported
	@touch $@

# Other people's programs, for outside checks; where one cannot be had, its test is skipped.
CLIENTS := $(VENV)/.clients
.PHONY: clients
clients: $(CLIENTS)
$(CLIENTS): $(READY)
	-$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[clients]'
	-$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[luxx]'
	-$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[genicam]'
	-$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[browser]'
	@touch $@

demo: $(READY)
	$(BIN)/disco-twin run scenes/quick.toml --out $(OUT)
	$(BIN)/disco-twin view $(OUT)

# The laser's timing alone. Then what waits for devices, in a process of its own that gets a core whenever it wants one,
# beside what computes, on every core; each worker's linear algebra keeps to one of them.
DEVICES := tests/unit/hw tests/unit/disco_twin/emulation tests/unit/pipeline/capture/test_loop.py tests/system/test_rig.py
DEVICE_LOG := $(VENV)/devices.log
test: $(CLIENTS)
	@status=0; \
	$(BIN)/python -m pytest $(DEVICES) -m timing || status=1; \
	$(BIN)/python -m pytest $(DEVICES) -m "not (slow or timing)" >$(DEVICE_LOG) 2>&1 & devices=$$!; \
	OMP_NUM_THREADS=1 nice -n 10 $(BIN)/python -m pytest -n auto -m "not (device or slow or timing)" || status=1; \
	wait $$devices || status=1; \
	echo "tests of devices, which ran at the same time:"; cat $(DEVICE_LOG); \
	exit $$status

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

validate: $(CLIENTS)
	$(BIN)/python -m pytest -m "slow or not slow" --timeout 1800

# After a change of a scene's object, lights or held-out views, and then commit them. What is there already stays.
REFERENCED := scenes/quick.toml $(sort $(wildcard scenes/accuracy/*/*.toml))
references: $(READY)
	@for scene in $(REFERENCED); do \
	  $(BIN)/disco-twin reference $$scene --out "$$(dirname $$scene)/references/$$(basename $$scene .toml)" || exit 1; \
	done

outside: $(READY)
	$(BIN)/python -m benchmarks.volpath_references

accuracy: $(READY)
	$(BIN)/python -m benchmarks accuracy --json docs/benchmarks/accuracy.json
	$(BIN)/python -m benchmarks.accuracy_table docs/benchmarks/accuracy.json docs/accuracy.md

regression: $(READY)
	$(BIN)/python -m benchmarks.frozen

picture: $(READY)
	$(BIN)/python -m benchmarks.readme_picture $(OUT) docs/picture.png

curves: $(READY)
	$(BIN)/python -m benchmarks walk --json docs/benchmarks/walk.json
	$(BIN)/python -m benchmarks.plot docs/benchmarks/walk.json docs/benchmarks/walk.svg

soak: $(READY)
	$(BIN)/python -m benchmarks soak --json $(VENV)/soak.json

stability: $(READY)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks stability --json docs/benchmarks/stability.json
	$(BIN)/python -m benchmarks.stability.page docs/benchmarks/stability.json docs/stability.md

clean:
	rm -rf $(VENV) out build dist
