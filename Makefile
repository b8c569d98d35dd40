# Every target makes its own environment and needs python3, pip and make alone.
PYTHON ?= python3
VENV ?= .venv
PYTEST_ARGS ?=
PAPER_ARGS ?= --resume

BIN := $(VENV)/bin
CART := models/shopping_cart

PAPER := shopping_cart apartment wrong_model wrong_model_box2d scaling

.PHONY: demo paper test test-fast test-generation test-long test-properties lint notebooks docs clean
.DELETE_ON_ERROR:

demo: $(VENV)/.installed
	$(BIN)/pbrl-ppl close-loop $(CART)/scene.toml $(CART)/recorded/train.csv \
	    --test $(CART)/recorded/test.csv -o out/demo --overwrite

# Run the paper's experiments at their published size and print their numbers. An interrupted run is
# resumed. `make paper PAPER_ARGS=--quick` runs small versions, into folders of another name.
paper: $(VENV)/.installed-test
	for experiment in 04_shopping_cart.py 05_apartment.py 06_wrong_model.py "06_wrong_model.py --box2d" \
	    07_scaling.py; do $(BIN)/python analysis/$$experiment $(PAPER_ARGS) || exit 1; done
	$(BIN)/python analysis/benchmarks/agents.py --results \
	    $(PAPER:%=out/%$(if $(findstring --quick,$(PAPER_ARGS)),_quick))

# One worker runs a whole file, so that its fixtures are made once; the marker `first` sets the order.
PYTEST := $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --durations 20

test: $(VENV)/.compiled
	$(PYTEST) $(PYTEST_ARGS)

test-fast: $(VENV)/.compiled
	$(PYTEST) -m 'not slow and not long' $(PYTEST_ARGS)

# the fast tests that depend on the generation of PyMC and ArviZ
test-generation: $(VENV)/.installed-test
	$(PYTEST) -m 'not slow and not long and not one_stack' $(PYTEST_ARGS)

test-long: $(VENV)/.installed-test
	$(PYTEST) -m long $(PYTEST_ARGS)

# the properties that Hypothesis tries, with four times as many examples as `make test`
test-properties: $(VENV)/.installed-test
	$(PYTEST) -m hypothesis --hypothesis-profile long $(PYTEST_ARGS)

lint: $(VENV)/.installed-lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Run the notebooks and write them as .ipynb and HTML with their pictures. Their kernel is this
# environment's Python, their working directory this folder.
notebooks: $(VENV)/.installed-docs
	mkdir -p out/notebooks
	for notebook in analysis/notebooks/*.py; do \
	    page=out/notebooks/$$(basename $$notebook .py).ipynb; \
	    $(BIN)/jupytext --to ipynb --set-kernel python3 --execute --run-path . --output $$page $$notebook \
	        && $(BIN)/jupyter-nbconvert --to html $$page || exit 1; \
	done

# Warnings are errors. Notebooks have their pictures if `make notebooks` was run before.
docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --config-file analysis/docs/mkdocs.yml

clean:
	rm -rf .venv .venv-next build out *.egg-info
	rm -rf .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Each worker of the tests would compile the engine's loops, a minute: each process here compiles half.
COMPILE := $(BIN)/python -c "import sys; from pbrl_ppl.physics import compile_loops; compile_loops(sys.argv[1:])"

$(VENV)/.compiled: $(wildcard pbrl_ppl/physics/*.py) | $(VENV)/.installed-test
	$(COMPILE) joined & $(COMPILE) single touching && wait $$!
	touch $@

# Some distributions package Python without ensurepip: there the system's pip fills the environment.
$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "pbrl_ppl needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) --version 2>&1)." \
	         "Name a newer one: make PYTHON=python3.12 ..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV) || { $(PYTHON) -m venv --clear --without-pip $(VENV) \
	    && $(PYTHON) -m pip --python $(BIN)/python install pip; }

$(VENV)/.installed: pyproject.toml setup.py | $(BIN)/python
	$(BIN)/python -m pip install -e .
	touch $@

$(VENV)/.installed-%: pyproject.toml setup.py | $(BIN)/python
	$(BIN)/python -m pip install -e '.[$*]'
	touch $@
