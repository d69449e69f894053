# make demo      from nothing to an evaluated policy, in .venv (made if it is missing)
# make test      the whole test suite
# make lint      formatting, lint and types
# make bench     speed and accuracy, against the tool that one would use instead where there is one
BIN := .venv/bin
INSTALLED := .venv/.installed
PYTEST_FLAGS ?=
# One thread for each of the two test processes: OpenMP's own would only fight over the cores.
ONE_THREAD := OMP_NUM_THREADS=1 MKL_NUM_THREADS=1

# What the demo runs; a stage's own defaults are right for a longer run.
DEMO := runs/demo
DEMO_TASK ?= stack
DEMO_EPISODES ?= 1500
DEMO_PRETRAIN ?= --updates 24000
DEMO_FINETUNE ?= --online.rounds 8 --online.evaluate-every 4
DEMO_EVALUATION ?= --episodes 100 --seed 1000

.PHONY: demo test lint bench install constraints
.DEFAULT_GOAL := demo

install: $(INSTALLED)

$(INSTALLED): pyproject.toml constraints.txt setup.sh
	./setup.sh

demo: $(INSTALLED)
	rm -rf $(DEMO)
	$(BIN)/eisp-collect --task $(DEMO_TASK) --episodes $(DEMO_EPISODES) --output-dir $(DEMO)/data
	$(BIN)/eisp-pretrain --dataset.root $(DEMO)/data --output-dir $(DEMO)/pretrain $(DEMO_PRETRAIN)
	$(BIN)/eisp-finetune --policy.path $(DEMO)/pretrain --output-dir $(DEMO)/run $(DEMO_FINETUNE)
	@echo "evaluating before and after fine-tuning"
	@$(BIN)/eisp-eval --policy.path $(DEMO)/pretrain $(DEMO_EVALUATION) --json \
	    > $(DEMO)/run/evaluation_before.json
	@$(BIN)/eisp-eval --policy.path $(DEMO)/run/best $(DEMO_EVALUATION) --json \
	    --video $(DEMO)/run/episode.mp4 > $(DEMO)/run/evaluation_after.json
	@$(BIN)/eisp-report --run-dir $(DEMO)/run

test: $(INSTALLED)
	$(ONE_THREAD) $(BIN)/python -m pytest -n 2 --dist loadfile $(PYTEST_FLAGS)

lint: $(INSTALLED)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

constraints: $(INSTALLED)
	$(BIN)/python -m pip install --quiet --editable '.[dev,bench,view,teleop]'
	$(BIN)/python .ci/constraints.py > constraints.txt.new && mv constraints.txt.new constraints.txt

bench: $(INSTALLED)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[bench]'
	for script in benchmarks/*.py; do $(BIN)/python $$script || exit 1; done
