# The main commands are `make demo` and `make test`. Both set up .venv first. They need only python3 (>= 3.11) with its
# headers and venv, make and a C++ compiler.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
PIP    := $(BIN)/python -m pip --disable-pip-version-check install --quiet
# Constraints in the environment also apply to the isolated build.
export PIP_CONSTRAINT := $(CURDIR)/constraints.txt
NATIVE := pyproject.toml constraints.txt CMakeLists.txt $(wildcard pcbench/native/*.cpp pcbench/native/*/*.cpp pcbench/native/*/*.h \
  reconstructors/*/native/*.cpp reconstructors/*/native/*.h reconstructors/splat/*.h reconstructors/splat/cpu/*.cpp \
  reconstructors/splat/cpu/*.h)

.PHONY: demo demo-clouds demo-bench test long variations lint types docs slow sanitize compilers processors wheel wheels sdist release bench instructions measured stale gallery notebooks wording pictures clean

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit("pcbench needs Python 3.11 or newer" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)

# An editable install does not rebuild C++ automatically, so the stamps depend on the native sources.
$(VENV)/.core: $(BIN)/python $(NATIVE)
	$(PIP) --no-deps --editable .
	@touch $@

$(VENV)/.plot: $(BIN)/python pyproject.toml constraints.txt packaging/requirements.py
	$(BIN)/python packaging/requirements.py plot > $@.txt
	$(PIP) --requirement $@.txt
	@touch $@

$(VENV)/.photographs: $(VENV)/.plot
	$(BIN)/python packaging/requirements.py sfm mvs splat field > $@.txt
	$(PIP) --requirement $@.txt
	@touch $@

$(VENV)/.all: $(BIN)/python $(NATIVE)
	$(PIP) --editable '.[all,dev]'
	@touch $(VENV)/.core $(VENV)/.plot $(VENV)/.photographs $@

# The core is compiled while packages are unpacked, and the first answer comes before all of them are there.
demo:
	@+$(MAKE) --no-print-directory --jobs 3 demo-bench

demo-clouds: $(VENV)/.core $(VENV)/.plot
	$(BIN)/pcbench demo --out demo --no-bench

demo-bench: demo-clouds $(VENV)/.photographs
	$(BIN)/pcbench demo --out demo --no-clouds

# Workers and child processes read compiled modules; otherwise each would compile pcbench and rewrite all asserts again.
unexport PYTHONDONTWRITEBYTECODE

test: $(VENV)/.all
	$(BIN)/python -m pytest -n 2 -m 'not long and not slow and not gpu'

long: $(VENV)/.all
	$(BIN)/python -m pytest -n 2 -m 'long and not slow and not gpu'

# Parts of the test suite with other kernels, thread counts and test orders, as on an older processor, and without
# optional system libraries.
variations: $(VENV)/.all
	$(BIN)/python tests/variations.py

slow: $(VENV)/.all
	$(BIN)/python -m pytest -m slow -o faulthandler_timeout=14400

# Build a portable wheel in dist/ and test it. It contains libgomp, which minimal containers lack.
wheel: $(VENV)/.all
	rm -rf dist build/dist
	$(BIN)/python -m build --wheel --outdir build/dist . >/dev/null
	PATH=$(CURDIR)/$(BIN):$$PATH $(BIN)/auditwheel repair --wheel-dir dist build/dist/*.whl
	PCBENCH_WHEELS="$$(echo dist/*.whl)" $(BIN)/python -m pytest tests/test_wheel.py

# Build wheels for all versions of Python, also for ARM, and test them with the lowest and highest dependencies. It uses
# the commands python3.11 to python3.14 that exist; pyenv has several with PYENV_VERSION=3.11.7:3.12.1.
wheels: $(VENV)/.all
	$(BIN)/python packaging/wheels.py

# Build the source distribution in dist/. Where scikit-build-core and nanobind are installed, `python -m build --sdist
# --no-isolation` and `pip install --no-index --no-build-isolation` from it need no network.
sdist: $(VENV)/.all
	$(BIN)/python -m build --sdist --outdir dist .

# Prepare a release, `make release VERSION=0.2.0`: version, changelog, sdist, wheels, site, tag, and a list of the rest.
release: $(VENV)/.all
	$(BIN)/python packaging/release.py '$(VERSION)'

# Check that the kernels give the same bits on this processor and, if Debian's g++-aarch64-linux-gnu and qemu-user are
# installed, on ARM.
processors: $(VENV)/.all
	$(BIN)/python -m pytest -s -m slow tests/native/test_golden.py

# Build the compiled core with another compiler or other settings: $(1) is the compiler, $(2) the folder in build/, $(3)
# the CMake definitions. Symbols are not stripped, so that reports contain line numbers.
other_core = CXX=$(1) $(PIP) --no-deps --upgrade --target build/$(2)/site . $(patsubst %,--config-settings %, \
  build-dir=build/$(2)/cmake install.strip=false cmake.build-type=RelWithDebInfo $(patsubst %,cmake.define.%,$(3)))

# Test the compiled core and the emulated CUDA kernels with address and undefined-behaviour sanitizers. The tests run on
# the base interpreter, because the editable install would be found first inside the virtual environment. Output is
# captured at the level of Python, so that reports of the sanitizers are visible.
CORE_TESTS := tests/geometry/test_neighbors.py tests/geometry/test_normals.py $(wildcard tests/geometry/test_mesh*.py) \
  tests/native/test_instruction_sets.py tests/reconstructors/mvs/test_patchmatch.py \
  tests/reconstructors/splat/test_twins.py tests/reconstructors/field/test_gradients.py
sanitize: $(VENV)/.all
	$(call other_core,g++,sanitize,'PCB_SANITIZE=address;undefined')
	LD_PRELOAD="$$(g++ -print-file-name=libasan.so) $$(g++ -print-file-name=libstdc++.so)" \
	  ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 OMP_NUM_THREADS=2 PYTHONSAFEPATH=1 \
	  EMULATOR_FLAGS='-g -fsanitize=address,undefined,float-cast-overflow -fno-sanitize-recover=all' \
	  PYTHONPATH=$(CURDIR)/build/sanitize/site:$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("platlib"))') \
	  $(realpath $(BIN)/python) -m pytest -p no:faulthandler --capture=sys $(CORE_TESTS)

# Build with g++ and clang; warnings are errors.
compilers: $(VENV)/.all
	$(call other_core,g++,g++,CMAKE_COMPILE_WARNING_AS_ERROR=ON)
	$(call other_core,clang++,clang++,CMAKE_COMPILE_WARNING_AS_ERROR=ON)

# tests/wording.txt holds the texts that users read. `make wording TESTS=tests/report` renews those of one folder.
wording: $(VENV)/.all
	$(BIN)/python -m pytest -n 2 --renew-wording $(TESTS)

# tests/pictures/ holds small golden pictures.
pictures: $(VENV)/.all
	$(BIN)/python -m pytest --renew-pictures tests/report/test_golden_pictures.py tests/plot/test_golden_views.py

lint: $(VENV)/.all
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/clang-format --dry-run --Werror $$(git ls-files '*.h' '*.cpp' '*.cu')
	$(BIN)/lint-imports --no-logo
	$(BIN)/python tests/prose.py
	$(BIN)/typos

types: $(VENV)/.all
	$(BIN)/mypy

# Build site/ from docs/ and the docstrings. Unresolved references are errors; nothing is downloaded.
docs: $(VENV)/.all
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet
	$(BIN)/python docs/check_site.py site

bench: $(VENV)/.all
	$(BIN)/python benchmarks/compare.py

# Compare the instructions of a small comparison with those of an earlier commit; needs Debian's valgrind.
instructions: $(VENV)/.all
	$(BIN)/python benchmarks/instructions.py

# Run the commands behind printed measurements whose code has changed, and write what they print into the pages. The list
# of commands with their seconds comes first; timings run alone, and the whole takes at most 2.5 hours on two quiet cores.
# `python docs/remeasure.py --list` prints the list alone.
# `make measured ONLY="speed tiles"` runs those whose page or command has one of these words. It installs the peers that PyPI
# has; CloudCompare comes with Debian.
measured: $(VENV)/.all
	$(PIP) pykdtree small_gicp point-cloud-utils py4dgeo opencv-python-headless
	$(BIN)/python docs/remeasure.py --only '$(ONLY)'

# List the tables of measurements that are older than the code they measure.
stale: $(BIN)/python
	$(BIN)/python docs/stale_tables.py

gallery: $(VENV)/.all
	PATH=$(CURDIR)/$(BIN):$$PATH $(BIN)/python docs/gallery.py

# Run the notebooks and store them with their outputs.
notebooks: $(VENV)/.all
	$(BIN)/python docs/notebooks.py

clean:
	rm -rf $(VENV) build dist demo site
