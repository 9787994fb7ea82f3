# Set-up and checks. Everything happens in .venv; nothing else on the machine is changed, except that `make test`
# installs Chromium, PostgreSQL and what .ci/packages names with apt when they are missing and you are root; no server is
# started but those of the tests.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m uv pip install --quiet --compile-bytecode --python $(BIN)/python
# A third of the time they wait: for time-outs, and for what they have started.
PROCESSES := $(shell expr $$(nproc) + 1)
PYTEST := $(BIN)/pytest -n $(PROCESSES) -p schemathesis.pytest.plugin -p nbval.plugin --nbval \
	--nbval-sanitize-with tests/notebooks/sanitize.cfg --durations=40 tests epypes widgets/epypes_widgets notebooks

# Hundreds of interpreters are started by the tests: each would compile all that it imports.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test soak test-matrix lab bench schema dist fix clean

demo: $(VENV)/.all
	$(BIN)/epypes demo notebooks/01_edge_detection.ipynb --name runner --output edges --to demo-output

test: $(VENV)/.test $(VENV)/.ros2 chromium postgres packages
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(PYTEST) -m "not soak"

# The long forms: every combination, long series, and far more examples for what searches at random:
# a quarter of an hour.
soak: $(VENV)/.test $(VENV)/.ros2 chromium postgres packages
	EPYPES_SOAK=1 $(PYTEST) -m "soak or fuzz" -o timeout=3600 -o faulthandler_timeout=3000

# The default selection on every other Python that is found, and on the lowest versions that pyproject.toml admits.
test-matrix: $(VENV)/.test
	@sh .ci/matrix $(BIN)/python 3.12 3.13 3.14 lowest

lab: $(VENV)/.all
	$(PIP) --editable '.[all,basler]'
	$(BIN)/epypes lab notebooks

bench: $(VENV)/.bench
	$(BIN)/python -m tests.benchmarks

# The documentation site: docs/_build/html/index.html. Nothing is downloaded; warnings are errors.
.PHONY: docs
docs: $(VENV)/.test
	$(BIN)/python -m sphinx --quiet --fresh-env --fail-on-warning --keep-going docs docs/_build/html

# After a change in proto/: the messages, as epypes/wire/protobuf.py loads them.
schema: $(VENV)/.test
	$(BIN)/python -m grpc_tools.protoc -Iproto --include_imports --descriptor_set_out=epypes/wire/schema.binpb \
		epypes2019/messages.proto epypes/v1/envelope.proto foxglove/images.proto

# The wheel and the source distribution of the tree as it is.
dist: | $(BIN)/python
	$(BIN)/python -m uv build --quiet --out-dir dist

fix: $(VENV)/.test
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) .matrix dist demo-output test-output results edges.html edges.png notebooks/edge_service notebooks/orb.* notebooks/*.toml notebooks/services notebooks/many_images services
	rm -rf docs/_build docs/reference/generated docs/tutorials

# uv comes from the same registry as everything else and installs eight times faster than pip.
$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "EPypes needs Python 3.11 or newer; name one: make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv

$(VENV)/.all: pyproject.toml | $(BIN)/python
	$(PIP) --editable '.[all]'
	touch $@

$(VENV)/.test: pyproject.toml | $(BIN)/python
	$(PIP) --editable '.[all]' --group test --group docs
	touch $@ $(VENV)/.all

# The nodes of ROS 2 that the tests exchange images with, in an environment of their own.
$(VENV)/.ros2: pyproject.toml | $(BIN)/python
	$(BIN)/python -m venv --without-pip $(VENV)/ros2
	$(BIN)/python -m uv pip install --quiet --compile-bytecode --python $(VENV)/ros2/bin/python --group ros2
	touch $@

$(VENV)/.bench: pyproject.toml | $(BIN)/python
	$(PIP) --editable '.[all]' --group test --group docs --group bench
	$(PIP) --target $(VENV)/published --no-deps epypes==0.1.1
	touch $@ $(VENV)/.test $(VENV)/.all

.PHONY: chromium postgres packages
chromium:
	@sh .ci/chromium
postgres:
	@sh .ci/postgres
packages:
	@sh .ci/packages
