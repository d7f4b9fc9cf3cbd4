# Every way to run things. `make demo` and `make test` set up all they need.

PY := .venv/bin/python
# What decides what .venv holds; `touch`ed markers say that it holds it.
DEMO := .venv/.demo
DEV := .venv/.dev
BENCH := .venv/.bench

# pytest rewrites Hypothesis and all tests in each process, unless it may keep their bytecode.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-core test-numpy test-e2e check build bench bench-trade fuzz clean

demo: $(DEMO)         ## the main job: the committed room, its cameras, half of it pruned, into out/
	$(PY) docs/demo.py

test: $(BENCH)        ## core, add-on and benchmark tests, all of them
	$(PY) -m pytest -n auto --maxprocesses 4 --dist worksteal

test-core: $(DEV)     ## core alone, in seconds: without slow tests, few random examples
	$(PY) -m pytest tests/core -m "not slow" --hypothesis-profile=quick -n auto

test-numpy: $(DEV)    ## core on the oldest and the newest NumPy that a supported Blender carries
	$(PY) .ci/numpy_ends.py

test-e2e: $(BENCH) build ## the installed zip in real Blenders; skips, with the reason, those not to be had
	$(PY) -m pytest tests/e2e --ignore tests/e2e/test_window.py --ignore tests/e2e/test_walk.py
	# Mouse clicks against a software renderer fail now and then on a busy machine: a test that
	# fails gets one more try, and failing twice fails the build.
	$(PY) -m pytest tests/e2e/test_w*.py || $(PY) -m pytest tests/e2e/test_w*.py --last-failed

check: $(DEV)         ## lint, format, types
	.venv/bin/ruff check && .venv/bin/ruff format --check && .venv/bin/mypy

build: $(DEV)         ## the extension's zip, validated, into build/
	$(PY) .ci/build_extension.py

bench: $(BENCH)       ## seconds and memory of whole commands beside splat-transform; QUICK=1: 160,000 splats
	$(PY) -m benchmarks.speed.whole $(if $(QUICK),--quick)

bench-trade: $(BENCH) ## quality over time: docs/trade.md; SCENES="folder ..." measures others, RAP=FILE RAP too
	-$(PY) -m benchmarks.baselines.splat_transform
	$(PY) -m benchmarks.tables.trade $(SCENES) $(if $(RAP),--rap $(RAP))

fuzz: $(DEV)          ## hostile files, for SECONDS
	$(PY) -m tests.fuzz --seconds $(or $(SECONDS),300)

clean:                ## all that was made
	rm -rf .venv .venv-* build out .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info

.venv/bin/python:
	sh .ci/make_venv .venv

$(DEMO): pyproject.toml | .venv/bin/python
	$(PY) -m pip install --quiet --editable '.[demo]'
	$(PY) .ci/check_libraries.py
	touch $@

$(DEV): pyproject.toml | .venv/bin/python
	$(PY) -m pip install --quiet --editable '.[dev]'
	$(PY) .ci/check_libraries.py
	touch $(DEMO) $@

$(BENCH): $(DEV)
	$(PY) -m pip install --quiet --editable '.[dev,bench]'
	touch $@
