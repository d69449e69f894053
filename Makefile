# make demo      from nothing to an evaluated policy, in .venv (made if it is missing)
# make test      the whole test suite
# make lint      formatting, lint and types
# make bench     speed, each number against the tool that one would use instead
BIN := .venv/bin
INSTALLED := .venv/.installed
PYTEST_FLAGS ?=
# One thread for each of the two test processes: OpenMP's own would only fight over the cores.
ONE_THREAD := OMP_NUM_THREADS=1 MKL_NUM_THREADS=1

.PHONY: demo test lint bench install constraints
.DEFAULT_GOAL := demo

install: $(INSTALLED)

$(INSTALLED): pyproject.toml constraints.txt setup.sh
	./setup.sh

test: $(INSTALLED)
	$(ONE_THREAD) $(BIN)/python -m pytest -n 2 --dist loadfile $(PYTEST_FLAGS)

lint: $(INSTALLED)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

constraints: $(INSTALLED)
	$(BIN)/python .ci/constraints.py > constraints.txt.new && mv constraints.txt.new constraints.txt

bench: $(INSTALLED)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[bench]'
	for script in benchmarks/*.py; do $(BIN)/python $$script || exit 1; done
