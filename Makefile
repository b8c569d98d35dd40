# Every target makes its own environment; python3, pip and make are all it takes.
PYTHON ?= python3
VENV ?= .venv
PYTEST_ARGS ?=
PAPER_ARGS ?= --resume

BIN := $(VENV)/bin
CART := models/shopping_cart

PAPER := shopping_cart apartment wrong_model wrong_model_box2d scaling

.PHONY: demo paper test test-fast test-generation test-long lint notebooks docs clean
.DELETE_ON_ERROR:

demo: $(VENV)/.installed
	$(BIN)/pbrl-ppl close-loop $(CART)/scene.toml $(CART)/recorded/train.csv \
	    --test $(CART)/recorded/test.csv -o out/demo --overwrite

# The paper's experiments at their published size, and their numbers; an interrupted run goes on.
# A smoke size: make paper PAPER_ARGS=--quick, into folders of another name.
paper: $(VENV)/.installed-test
	for experiment in 04_shopping_cart.py 05_apartment.py 06_wrong_model.py "06_wrong_model.py --box2d" \
	    07_scaling.py; do $(BIN)/python analysis/$$experiment $(PAPER_ARGS) || exit 1; done
	$(BIN)/python analysis/benchmarks/agents.py --results \
	    $(PAPER:%=out/%$(if $(findstring --quick,$(PAPER_ARGS)),_quick))

# A file's fixtures are made once, by the worker that has it; tests/conftest.py has the order.
PYTEST := $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --durations 10

test: $(VENV)/.installed-test
	$(PYTEST) $(PYTEST_ARGS)

test-fast: $(VENV)/.installed-test
	$(PYTEST) -m 'not slow and not long' $(PYTEST_ARGS)

# what may differ between the generations of PyMC and ArviZ
test-generation: $(VENV)/.installed-test
	$(PYTEST) -m 'not slow and not long and not one_stack' $(PYTEST_ARGS)

test-long: $(VENV)/.installed-test
	$(PYTEST) -m long $(PYTEST_ARGS)

lint: $(VENV)/.installed-lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -c 'from tests.test_rooms import test_sizes; test_sizes()'

# as .ipynb and HTML with their pictures; jupytext runs them, from here, in a kernel of its own Python
notebooks: $(VENV)/.installed-docs
	mkdir -p out/notebooks
	for notebook in analysis/notebooks/*.py; do \
	    page=out/notebooks/$$(basename $$notebook .py).ipynb; \
	    $(BIN)/jupytext --to ipynb --set-kernel python3 --execute --run-path . --output $$page $$notebook \
	        && $(BIN)/jupyter-nbconvert --to html $$page || exit 1; \
	done

# warnings are errors; notebooks have their pictures where `make notebooks` was run before
docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --config-file analysis/docs/mkdocs.yml

clean:
	rm -rf .venv .venv-next build out *.egg-info
	rm -rf .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Where Python comes without ensurepip (some distributions split it off), its pip fills the venv.
$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "pbrl_ppl needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) --version 2>&1)." \
	         "Name a newer one: make PYTHON=python3.12 ..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV) || { $(PYTHON) -m venv --clear --without-pip $(VENV) \
	    && $(PYTHON) -m pip --python $(BIN)/python install pip; }

$(VENV)/.installed: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install -e .
	touch $@

$(VENV)/.installed-%: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install -e '.[$*]'
	touch $@
