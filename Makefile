# make demo: from a bare machine to the demo's numbers and figures. make test: everything CI checks.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test lint bench harness accuracy pictures docs docs-links clean

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ".[dev]"
	touch $(STAMP)

demo: $(STAMP)
	$(BIN)/rtof-kin demo -o out/demo --overwrite

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python models/build_urdf.py --check

test: lint
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile
	OMP_NUM_THREADS=1 $(BIN)/python examples/quickstart.py models/demo out/quickstart
	$(BIN)/python tests/check_wheel.py
	$(BIN)/python tests/check_real_video.py

# Solvers side by side: time, energy, gradient, frames per second. About ten minutes.
bench: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.solvers

# Accuracy and speed on six seconds of the demo, within wide bounds. Under a minute.
.PHONY: bench-smoke
bench-smoke: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.smoke

# Accuracy on test motions; CORPUS is the folder of free motion that benchmarks/README.md describes.
harness: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.harness --corpus $(CORPUS)

accuracy: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.accuracy --corpus $(CORPUS)

# Pictures of README and docs, with the package as it is; needs a Chromium. About ten minutes.
pictures: $(STAMP)
	$(BIN)/python -m docs.pictures $(if $(DATA),--data $(DATA))

$(VENV)/.installed-docs: $(STAMP)
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ".[docs]"
	touch $@

# The documentation site: docs/_build/html/index.html. The tutorials run. docs-links looks up the addresses on the web.
SPHINX = OMP_NUM_THREADS=1 $(BIN)/python -m sphinx -q -E -c docs -d docs/_build/doctrees --fail-on-warning --keep-going
docs: $(VENV)/.installed-docs
	$(SPHINX) -b html . docs/_build/html

docs-links: $(VENV)/.installed-docs
	$(SPHINX) -b linkcheck . docs/_build/links

clean:
	rm -rf $(VENV) out build dist docs/_build
