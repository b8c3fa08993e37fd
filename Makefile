# make demo: from a bare machine to the demo's numbers. make test: everything CI checks.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test coverage test-lowest lint lint-platforms dist sbom bench bench-smoke harness accuracy pictures docs docs-links clean

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ".[dev]"
	touch $(STAMP)

demo: $(STAMP)
	$(BIN)/rtof-kin run --demo -o out/demo --overwrite

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python models/build_urdf.py --check

# The types on other systems; a minute each the first time.
lint-platforms: $(STAMP)
	$(BIN)/mypy --platform win32 --cache-dir .mypy_cache/win32
	$(BIN)/mypy --platform darwin --cache-dir .mypy_cache/darwin

# The tests write bytecode: the programs that they start load in 0.6 s less. Three workers, as some tests wait for them.
test: lint
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 3 --dist loadfile
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks smoke --slowdown
	OMP_NUM_THREADS=1 $(BIN)/python examples/quickstart.py models/demo out/quickstart
	$(BIN)/python tests/check_wheel.py
	$(BIN)/python tests/check_real_video.py
	DOCS_EXECUTION=off $(MAKE) docs

# The tests with the branch coverage of rtof_kin and lifting; a third longer than without.
coverage: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile --cov --cov-report=term

# The tests that need no extra, with the lowest versions that pyproject.toml allows.
LOWEST := .venv-lowest
PLAIN_TESTS := tests/body tests/clinical tests/data tests/formats tests/inertial
test-lowest: $(STAMP)
	$(BIN)/uv venv --quiet --clear --python $(BIN)/python $(LOWEST)
	$(BIN)/uv pip install --quiet --python $(LOWEST) --resolution lowest-direct -e ".[figures,parquet,live]"
	$(BIN)/uv pip install --quiet --python $(LOWEST) "pytest>=8.2" pytest-xdist hypothesis
	OMP_NUM_THREADS=1 $(LOWEST)/bin/python -m pytest -n 2 --dist loadfile -W ignore::DeprecationWarning $(PLAIN_TESTS)

# Source distribution and wheel in dist/, the same bytes from the same commit.
dist: $(STAMP)
	rm -rf dist
	SOURCE_DATE_EPOCH=$$(git log -1 --format=%ct) $(BIN)/python -m build --no-isolation -o dist .
	$(BIN)/twine check --strict dist/*.whl dist/*.tar.gz

# Bill of materials of an installation with all extras, in CycloneDX: dist/rtof-kin.cdx.json.
sbom: $(STAMP)
	mkdir -p dist
	$(PYTHON) -m venv $(VENV)-sbom
	$(VENV)-sbom/bin/python -m pip install --quiet -c constraints.txt ".[all]"
	$(BIN)/cyclonedx-py environment --pyproject pyproject.toml --output-reproducible \
		--spec-version 1.6 --output-format JSON -o dist/rtof-kin.cdx.json $(VENV)-sbom/bin/python

# Solvers side by side: time, energy, gradient, frames per second. About ten minutes.
bench: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks solvers

# Accuracy and speed on six seconds of the demo, within wide bounds. Under a minute.
bench-smoke: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks smoke

# Accuracy on test motions; CORPUS is the folder of free motion that benchmarks/README.md describes.
harness: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks harness --corpus $(CORPUS)

accuracy: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks accuracy --corpus $(CORPUS)

# Pictures of README and docs, with the package as it is; needs a Chromium. About ten minutes.
pictures: $(STAMP)
	$(BIN)/python -m docs.pictures $(if $(DATA),--data $(DATA))

$(VENV)/.installed-docs: $(STAMP)
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ".[docs]"
	touch $@

# The documentation site: docs/_build/html/index.html. The tutorials run. docs-links looks up the addresses on the web.
SPHINX = OMP_NUM_THREADS=1 RTOF_KIN_COMPILE=never $(BIN)/python -m sphinx -q -E -c docs -d docs/_build/doctrees --fail-on-warning --keep-going
docs: $(VENV)/.installed-docs
	$(SPHINX) -b html . docs/_build/html

docs-links: $(VENV)/.installed-docs
	$(SPHINX) -b linkcheck . docs/_build/links

clean:
	rm -rf $(VENV) $(VENV)-sbom $(LOWEST) out build dist docs/_build
