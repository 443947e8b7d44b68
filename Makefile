# Needs python3 (3.10 or newer, with venv; 3.11 for the tests) and make; everything else is installed into .venv.
#
#   make demo    install and run the demo
#   make test    install, then lint, format check, types, tests
#   make docs    install what the documentation needs, and build it as a site in build/docs
#   make results       run the benchmarks whose rows are not of this commit, an evening on two cores, and write the tables
#                      of the pages; make results ONLY="stream nophoto" runs some. benchmarks/results.py --list has all
#   make results-long  run the benchmarks that take half an hour or more each
#   make peers   install what some tests compare with and otherwise skip: Node 22, splat-transform, Spark, PlayCanvas; by npm, 400 MB
#   make clean   remove .venv and everything that was built or cached; what the demo made, in demo/, stays
#
# PYTHON    the interpreter that .venv is made from.
# PIP_ARGS  handed to pip install. From PyPI, torch on Linux brings gigabytes of CUDA libraries; its CPU build
#           is much smaller: make demo PIP_ARGS="--extra-index-url https://download.pytorch.org/whl/cpu"
PYTHON ?= python3
PIP_ARGS ?=
ONLY ?=

VENV := .venv
BIN := $(VENV)/bin
PEERS := $(VENV)/peers

.PHONY: demo test docs results results-long peers clean

demo: $(VENV)/.installed-demo
	$(BIN)/clod-adapt demo

test: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	PATH="$(CURDIR)/$(PEERS)/node_modules/.bin:$$PATH" $(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist worksteal

docs: $(VENV)/.installed-docs
	$(BIN)/python docs/make.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "open build/docs/index.html"

results: $(VENV)/.installed-dev
	$(BIN)/python benchmarks/results.py $(ONLY)

results-long: $(VENV)/.installed-dev
	$(BIN)/python benchmarks/results.py --long $(ONLY)

peers: $(PEERS)/.installed

clean:
	rm -rf $(VENV) build dist *.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find clod_adapter cli tests examples benchmarks -type d -name __pycache__ -prune -exec rm -rf {} +

# One stamp per extra: a second call installs nothing unless what is to be installed changed.
$(VENV)/.installed-%: pyproject.toml constraints.txt | $(BIN)/pip
	$(BIN)/python -m pip install $(PIP_ARGS) -c constraints.txt -e ".[$*]"
	touch $@

$(PEERS)/.installed: Makefile | $(BIN)/pip
	npm install --no-fund --no-audit --prefix $(PEERS) node@22.23.3 @playcanvas/splat-transform@3.7.0 \
	    @sparkjsdev/spark@2.2.0 three@0.180.0 playcanvas@2.23.0
	touch $@

# pip and not python: it comes last, so a venv that was interrupted is made again.
$(BIN)/pip:
	$(PYTHON) -m venv $(VENV) || { \
	    echo "$(PYTHON) cannot make a virtual environment; Debian and Ubuntu need the package python3-venv" >&2; \
	    exit 1; }
