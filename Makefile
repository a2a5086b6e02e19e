# Two commands matter: `make demo` and `make test`. Both set up .venv first; nothing but python3 (>= 3.11) with its
# headers and venv, make and a C++ compiler is needed beforehand.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
PIP    := $(BIN)/python -m pip --disable-pip-version-check install --quiet
# Constraints in the environment reach the isolated build too.
export PIP_CONSTRAINT := $(CURDIR)/constraints.txt
NATIVE := pyproject.toml constraints.txt CMakeLists.txt $(wildcard pcbench/native/*.cpp pcbench/native/*/*.cpp pcbench/native/*/*.h \
  reconstructors/*/native/*.cpp reconstructors/*/native/*.h reconstructors/splat/*.h reconstructors/splat/cpu/*.cpp \
  reconstructors/splat/cpu/*.h)

.PHONY: demo test variations lint types docs slow sanitize compilers processors wheel bench gallery wording clean

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit("pcbench needs Python 3.11 or newer" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)

# An editable install does not rebuild C++ by itself: the stamps depend on the native sources.
$(VENV)/.demo: $(BIN)/python $(NATIVE)
	$(PIP) --editable '.[plot,sfm,mvs,splat]'
	@touch $@

$(VENV)/.all: $(BIN)/python $(NATIVE)
	$(PIP) --editable '.[all,dev]'
	@touch $@ $(VENV)/.demo

demo: $(VENV)/.demo
	$(BIN)/pcbench demo --out demo

test: $(VENV)/.all
	$(BIN)/python -m pytest -n 2

# Parts of the suite with other kernels, numbers of threads and orders, as on an older processor, and without the optional
# system libraries.
variations: $(VENV)/.all
	$(BIN)/python tests/variations.py

slow: $(VENV)/.all
	$(BIN)/python -m pytest -m slow

# A wheel for other machines in dist/. libgomp goes into it: a plain container has none. What is in it is tested.
wheel: $(VENV)/.all
	rm -rf dist build/dist
	$(BIN)/python -m build --wheel --outdir build/dist . >/dev/null
	PATH=$(CURDIR)/$(BIN):$$PATH $(BIN)/auditwheel repair --wheel-dir dist build/dist/*.whl
	PCBENCH_WHEEL="$$(echo dist/*.whl)" $(BIN)/python -m pytest tests/test_wheel.py

# The kernels on this processor and, where Debian's g++-aarch64-linux-gnu and qemu-user are there, on ARM: the same bits.
processors: $(VENV)/.all
	$(BIN)/python -m pytest -s -m slow tests/native/test_golden.py

# The compiled core once more, by another compiler or with other settings: $(1) is the compiler, $(2) the folder in
# build/, $(3) what CMake defines. Nothing is stripped, so that reports name lines.
other_core = CXX=$(1) $(PIP) --no-deps --upgrade --target build/$(2)/site . $(patsubst %,--config-settings %, \
  build-dir=build/$(2)/cmake install.strip=false cmake.build-type=RelWithDebInfo $(patsubst %,cmake.define.%,$(3)))

# The tests of the compiled core with every access and every operation checked. They run on the interpreter under the
# virtual environment: inside it the editable install would be found first. Captured at Python's level, reports show.
# So are the CUDA kernels, emulated.
CORE_TESTS := tests/geometry/test_neighbors.py tests/geometry/test_normals.py $(wildcard tests/geometry/test_mesh*.py) \
  tests/native/test_instruction_sets.py tests/reconstructors/mvs/test_patchmatch.py \
  tests/reconstructors/splat/test_twins.py
sanitize: $(VENV)/.all
	$(call other_core,g++,sanitize,'PCB_SANITIZE=address;undefined')
	LD_PRELOAD="$$(g++ -print-file-name=libasan.so) $$(g++ -print-file-name=libstdc++.so)" \
	  ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 OMP_NUM_THREADS=2 PYTHONSAFEPATH=1 \
	  EMULATOR_FLAGS='-g -fsanitize=address,undefined,float-cast-overflow -fno-sanitize-recover=all' \
	  PYTHONPATH=$(CURDIR)/build/sanitize/site:$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("platlib"))') \
	  $(realpath $(BIN)/python) -m pytest -p no:faulthandler --capture=sys $(CORE_TESTS)

# Neither compiler has a warning.
compilers: $(VENV)/.all
	$(call other_core,g++,g++,CMAKE_COMPILE_WARNING_AS_ERROR=ON)
	$(call other_core,clang++,clang++,CMAKE_COMPILE_WARNING_AS_ERROR=ON)

# Texts that users read stand in tests/wording.txt. `make wording TESTS=tests/report` renews those of one folder.
wording: $(VENV)/.all
	$(BIN)/python -m pytest -n 2 --renew-wording $(TESTS)

lint: $(VENV)/.all
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/clang-format --dry-run --Werror $$(git ls-files '*.h' '*.cpp' '*.cu')
	$(BIN)/lint-imports --no-logo
	$(BIN)/python tests/prose.py
	$(BIN)/typos

types: $(VENV)/.all
	$(BIN)/mypy

# Into site/, from docs/ and the docstrings; whatever does not resolve is an error. Nothing is fetched.
docs: $(VENV)/.all
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet
	$(BIN)/python docs/check_site.py site

bench: $(VENV)/.all
	$(BIN)/python tests/bench/compare.py

gallery: $(VENV)/.all
	PATH=$(CURDIR)/$(BIN):$$PATH $(BIN)/python docs/gallery.py

clean:
	rm -rf $(VENV) build dist demo site
