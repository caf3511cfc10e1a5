# Each target sets up what it needs in a local environment; only Python itself must be there.
PYTHON ?= python3
BIN := .venv/bin
TOO_OLD := "sb3_esad needs Python 3.10 or newer, $(PYTHON) is %d.%d; choose another with make PYTHON=python3.11"

.PHONY: demo test test-lowest lint type format benchmark docs

# Train briefly, evaluate and print the metrics.
demo: .venv/.demo
	$(BIN)/python -m sb3_esad demo

# Two workers, for the tests are many and small; tests/conftest.py gives each of them one thread. Those that ask for two
# would else wait for each other by spinning, on cores that the other worker needs.
test test-lowest: export OMP_WAIT_POLICY = PASSIVE
test: .venv/.tests
	$(BIN)/python -m pytest -n 2

# With the lowest versions that setup.cfg admits, without RL Zoo, whose lowest version is the one in constraints.txt.
test-lowest: .venv-lowest/.done
	.venv-lowest/bin/python -m pytest -n 2 $(addprefix --ignore=tests/,test_benchmark.py test_docs.py test_hub.py test_resuming.py test_zoo.py test_zoo_upstream.py)

lint: .venv/.tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

type: .venv/.tests
	$(BIN)/mypy

format: .venv/.tests
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# What a step, an update and a decision take, as ratios within one run.
benchmark: .venv/.tests
	$(BIN)/python benchmark/scenario_speed.py
	$(BIN)/python benchmark/update_speed.py
	$(BIN)/python benchmark/predict_latency.py
	$(BIN)/python benchmark/overhead.py --memory-steps 0

# The site; warnings are errors, for most of them are links that lead nowhere. Docstrings are read from the code beside it.
docs: .venv/.docs
	$(BIN)/python -m sphinx -W --keep-going --quiet docs build/docs
	@echo "Written: build/docs/index.html"

# The demo has ten minutes in all: it needs no tools, and to compile all of torch takes longer than to import what is used.
# Each stamp is named after the extras that it stands for.
.venv/.demo .venv/.tests .venv/.docs: setup.cfg constraints.txt
	@$(PYTHON) -c 'import sys; sys.version_info >= (3, 10) or sys.exit($(TOO_OLD) % sys.version_info[:2])'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable ".[$(@:.venv/.%=%)]"
	@touch $@

.venv-lowest/.done: setup.cfg constraints-lowest.txt
	$(PYTHON) -m venv .venv-lowest
	.venv-lowest/bin/python -m pip install --quiet --no-compile --constraint constraints-lowest.txt \
		--editable ".[demo,watch]" pytest pytest-xdist hypothesis moviepy
	@touch $@
