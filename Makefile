# make demo    install, run the main job on a simulated basin, say where the report is
# make test    install, run the fast tests
# make test-slow, make test-thorough   the slow tests; every property with many examples
# make check   lint, format, types, import contracts
# make bench-page   estimators and rules of others on recordings and basins, hours; SONAR_GRAPH_DATA=folder of recordings
# make bench-speed   ratios of speed beside the accepted ones, 5 minutes; ARGS=--accept accepts the measured ones
# make docs    the documentation as a site, in build/site: pages to open in a browser, without a network
# PYTHON=python3.13 chooses the interpreter, VENV=folder the environment.

PYTHON ?= python3
VENV ?= .venv
DEMO ?= demo
BENCH ?= bench
BIN := $(VENV)/bin
# Modules are translated at their first import: most of those that pip would translate are never imported.
PIP := $(BIN)/python -m pip install --disable-pip-version-check --no-compile
# One line on a terminal that shows what pip does, and nothing elsewhere; sh has no pipefail, so the code goes by a file.
define install
@echo "Installing $(1) into $(VENV)" >&2
@code=$$(mktemp) && { $(PIP) $(2); echo $$? >$$code; } | if [ -t 2 ]; then \
  awk '{ printf "\r\033[K%.76s", $$0 >"/dev/stderr"; fflush("/dev/stderr") } END { printf "\r\033[K" >"/dev/stderr" }'; \
  else cat >/dev/null; fi; status=$$(cat $$code); rm -f $$code; exit $$status
endef

.PHONY: bench-page bench-speed demo docs test test-slow test-thorough check format wheel check-wheel install clean

demo: $(VENV)/.installed
	$(BIN)/sonar-graph demo -o $(DEMO)

# Loops are compiled before the workers start; each of them would compile them for itself. Tests of a file share a worker,
# so that what a file prepares once is prepared once.
test: $(VENV)/.installed-tests
	$(BIN)/python tests/compile_kernels.py
	$(BIN)/python -m pytest -n auto --dist loadfile

test-slow: $(VENV)/.installed-tests
	$(BIN)/python tests/compile_kernels.py
	$(BIN)/python -m pytest -n auto --dist loadfile -m slow

# All properties with a hundred examples each instead of twenty.
test-thorough: $(VENV)/.installed-tests
	$(BIN)/python tests/compile_kernels.py
	$(BIN)/python -m pytest -n auto --dist loadfile --hypothesis-profile=thorough

# Scripts are no library, and most are not run by the tests: of them only names and arguments are checked.
SCRIPTS = $(BIN)/mypy --config-file= --check-untyped-defs --ignore-missing-imports --explicit-package-bases \
	$(addprefix --disable-error-code=,arg-type assignment call-overload func-returns-value index misc operator \
	return-value type-var union-attr var-annotated)
SCRIPT_PATH = benchmarks:benchmarks/performance:benchmarks/validation:benchmarks/published_rules:benchmarks/actag_plugin

check: $(VENV)/.installed-lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	MYPYPATH=$(SCRIPT_PATH) $(SCRIPTS) benchmarks/validation
	MYPYPATH=$(SCRIPT_PATH) $(SCRIPTS) benchmarks/performance
	$(BIN)/lint-imports

# A warning ends it: a dead link, a page that is in no menu, a tutorial or a docstring that fails.
docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --config-file docs/site/mkdocs.yml
	@echo "Open build/site/index.html"

format: $(VENV)/.installed-lint
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# All estimators, and rules of other projects, on recordings and basins: one page. Recordings: SONAR_GRAPH_DATA=folder.
bench-page: $(VENV)/.installed
	$(call install,sonar-graph[bench],--editable '.[bench]' --editable benchmarks/published_rules)
	$(BIN)/sonar-graph bench benchmarks/suites/open.toml -o $(BENCH)

# Ratios of times from scripts in which both sides take turns. ARGS: --quick, --rounds 3, --accept
bench-speed: $(VENV)/.installed-tests
	$(BIN)/python benchmarks/performance/speed.py $(ARGS)

wheel: $(BIN)/python
	rm -rf dist
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir dist .

# The wheel alone, in an empty environment and another folder, does the main job.
check-wheel: wheel
	rm -rf build/wheel-check
	$(BIN)/python -m venv build/wheel-check
	build/wheel-check/bin/python -m pip install --quiet --disable-pip-version-check dist/*.whl
	cd build/wheel-check && bin/sonar-graph demo -o demo

install: $(VENV)/.installed

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))' || { \
	  echo "sonar-graph needs Python 3.11 to 3.14; '$(PYTHON)' is another or missing. Name one: make PYTHON=python3.12" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "'$(PYTHON)' cannot make virtual environments; on Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml | $(BIN)/python
	$(call install,sonar-graph and its libraries,--editable .)
	@touch $@

$(VENV)/.installed-tests: pyproject.toml | $(BIN)/python
	$(call install,sonar-graph[tests],--editable '.[tests]')
	@touch $@ $(VENV)/.installed

$(VENV)/.installed-docs: pyproject.toml | $(BIN)/python
	$(call install,sonar-graph[docs],--editable '.[docs]')
	@touch $@ $(VENV)/.installed

$(VENV)/.installed-lint: pyproject.toml | $(BIN)/python
	$(call install,sonar-graph[lint],--editable '.[lint]')
	@touch $@ $(VENV)/.installed

clean:
	rm -rf $(VENV) build dist
