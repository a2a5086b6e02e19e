# Two commands matter: `make demo` and `make test`. Both set up .venv first; nothing but python3 (>= 3.11), venv,
# make and a C++ compiler is needed beforehand.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
PIP    := $(BIN)/python -m pip --disable-pip-version-check install --quiet
# Constraints in the environment reach the isolated build too.
export PIP_CONSTRAINT := $(CURDIR)/constraints.txt
NATIVE := pyproject.toml constraints.txt CMakeLists.txt $(wildcard pcbench/native/*.cpp pcbench/native/*.h)

.PHONY: demo test lint types slow bench gallery clean

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit("pcbench needs Python 3.11 or newer" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)

# An editable install does not rebuild C++ by itself: the stamps depend on the native sources.
$(VENV)/.demo: $(BIN)/python $(NATIVE)
	$(PIP) --editable '.[plot]'
	@touch $@

$(VENV)/.all: $(BIN)/python $(NATIVE)
	$(PIP) --editable '.[all,dev]'
	@touch $@ $(VENV)/.demo

demo: $(VENV)/.demo
	$(BIN)/pcbench demo --out demo

test: $(VENV)/.all
	$(BIN)/python -m pytest -n 2

slow: $(VENV)/.all
	$(BIN)/python -m pytest -m slow

lint: $(VENV)/.all
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.all
	$(BIN)/mypy

bench: $(VENV)/.all
	$(BIN)/python tests/bench/compare.py

gallery: $(VENV)/.demo
	PATH=$(CURDIR)/$(BIN):$$PATH $(BIN)/python docs/gallery.py

clean:
	rm -rf $(VENV) build dist demo
