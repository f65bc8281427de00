# make demo: a picture of a sunken ship as a sonar sees it. make test: the essence of every module, in minutes.
# make test-all: all tests but the slow ones, and the notebooks. Each makes .venv first.
PYTHON ?= python3
VENV ?= .venv
PIP = $(VENV)/bin/python -m pip install -q --disable-pip-version-check -c constraints.txt
SOURCES = pyproject.toml constraints.txt

# compiled modules are kept: the tests start Python some hundred times
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-all docs coverage lint bench bench-quick clean system

demo: $(VENV)/.installed
	@rm -rf out/demo
	$(VENV)/bin/python -m mitsonar render sunken_ship --cartesian -o out/demo

# Threads of two workers on two cores wait for one another: one each. A file's tests stay together, since they share what is
# made; files begin in the order of tests/conftest.py, the longest first.
PYTEST = OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

test: $(VENV)/.tested
	$(PYTEST) -p no:nbmake -m "not slow and not thorough and not docs" tests $(PYTEST_FLAGS)

ALL = not slow and not docs
test-all: $(VENV)/.tested
	$(PYTEST) -m "$(ALL)" --nbmake tests benchmarks/notebooks $(PYTEST_FLAGS)

# how much of mitsonar the essence enters: a table of what it leaves out
coverage: $(VENV)/.tested
	$(PYTEST) -m "not slow and not thorough and not docs" --cov --cov-report=term tests $(PYTEST_FLAGS)

# the reference follows from the code, the rest is built without network
docs: $(VENV)/.installed
	$(PIP) -e '.[docs]'
	$(VENV)/bin/python docs/make_reference.py
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/python -m mkdocs build --strict

lint: $(VENV)/.tested
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	@mkdir -p build/typed/mitsonar
	@for one in mitsonar/* plugins scenes; do ln -sfn ../../../$$one build/typed/mitsonar/; done
	@ln -sfn ../../../benchmarks/recipes build/typed/mitsonar/recipes
	@ln -sfn ../../../benchmarks/reproduce build/typed/mitsonar/reproduction
	$(VENV)/bin/mypy -p mitsonar
	$(VENV)/bin/mypy tests benchmarks docs scenes

bench: $(VENV)/.tested
	$(PIP) -e '.[bench]'
	$(VENV)/bin/python benchmarks/bench_render.py
	$(VENV)/bin/python benchmarks/bench_dataset.py

# every script of benchmarks/, docs/ and scenes/ with --quick: does each still work?
bench-quick: $(VENV)/.tested
	$(VENV)/bin/python benchmarks/run_quick.py

system:
	@.ci/system_libraries

$(VENV)/bin/python: | system
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: $(SOURCES) | system $(VENV)/bin/python
	@echo "installing mitsonar into $(VENV) (about 100 MB to fetch)"
	$(PIP) -e .
	@touch $@

$(VENV)/.tested: $(SOURCES) $(VENV)/.installed
	@echo "installing what the tests need into $(VENV) (torch alone is 200 MB or more, see README)"
	$(PIP) -e '.[dev,learn]'
	@touch $@

clean:
	rm -rf $(VENV) out/demo build dist *.egg-info
