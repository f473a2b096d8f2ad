# The two commands of the README: make demo, make test. Needs Python 3.11+, pip, make and git.
PYTHON ?= python3
VENV ?= .venv
# Options for pip, e.g. PIP_ARGS="--index-url URL" to choose another build of torch.
PIP_ARGS ?=
BIN := $(VENV)/bin
# Of benchmarks the types are checked for names that are not there, not for values.
LOOSE := arg-type assignment call-arg call-overload dict-item index misc operator return-value union-attr var-annotated

.PHONY: demo test tests lint style types slow envelope docs notebooks addon test-blender clean
# The version of Blender, as a module of Python 3.11 (400 MB), in which test-blender runs the add-on.
BPY ?= 4.5.0
PYTHON_BPY ?= python3.11

demo: $(VENV)/.demo
	$(BIN)/hood rollout garment=swing_4k material=silk_crepe num_frames=60 output=outputs/demo
	@echo "Look at outputs/demo/contact_sheet.png and outputs/demo/rollout.mp4"

# Types are checked beside the tests: on one core they take half a minute.
test: style
	$(MAKE) --no-print-directory -j 2 types tests

tests: $(VENV)/.dev
	$(BIN)/python -m pytest -n auto --dist loadfile

slow: $(VENV)/.dev $(VENV)/.docs
	$(BIN)/python -m pytest -m slow

# Hours: the stability map, its page in outputs/envelope, and the section of hood/studies/notes/stability.md that is written from it.
envelope: $(VENV)/.demo
	$(BIN)/hood envelope output=outputs/envelope document=hood/studies/notes/stability.md

# The pages of docs/ with the reference of all public names, into site/; a warning is an error.
docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "Open site/index.html"

# The notebooks with what they print and draw; the tests run their code without Jupyter.
notebooks: $(VENV)/.notebooks
	$(BIN)/python -m tools.notebooks

# The add-on as the zip that Blender installs from disk.
addon:
	$(PYTHON) blender/make_zip.py outputs/hood_blender.zip

test-blender: $(VENV)/.dev $(VENV)/bpy-$(BPY)/.made
	HOOD_BLENDER_PYTHON=$(CURDIR)/$(VENV)/bpy-$(BPY)/bin/python $(BIN)/python -m pytest -m "slow or not slow" tests/blender

$(VENV)/bpy-$(BPY)/.made:
	$(PYTHON_BPY) -m venv $(@D)
	$(@D)/bin/python -m pip install -q $(PIP_ARGS) bpy==$(BPY) h5py pytest
	@touch $@

lint: style types

style: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

types: $(VENV)/.dev
	$(BIN)/mypy
	MYPYPATH=benchmarks $(BIN)/mypy $(LOOSE:%=--disable-error-code=%) benchmarks/*.py

$(VENV)/bin/python:
	$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11) and 'hood needs Python 3.11 or newer; set PYTHON=')"
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install -q $(PIP_ARGS) -c constraints.txt -e ".[pictures]"
	@touch $@

$(VENV)/.dev: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install -q $(PIP_ARGS) -c constraints.txt -e ".[dev]"
	@touch $@

$(VENV)/.docs: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install -q $(PIP_ARGS) -c constraints.txt -e ".[docs]"
	@touch $@

$(VENV)/.notebooks: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install -q $(PIP_ARGS) -c constraints.txt -e ".[notebooks]"
	@touch $@

clean:
	rm -rf $(VENV) outputs runs site
