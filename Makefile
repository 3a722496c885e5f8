# make demo   set up, then generate, train, clear tables and write demo/report.html (15 minutes on 2 cores)
# make test   lint, types, tests
# make bench  the figures of docs/benchmarks.md
PYTHON ?= python3
BIN := .venv/bin
DEMO := demo

.PHONY: setup demo test lint bench clean-demo

setup: .venv/.installed

.venv/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

demo: setup
	$(BIN)/dipn-datagen push --out $(DEMO)/data/push --episodes 1500
	$(BIN)/dipn-datagen images --out $(DEMO)/data/images --episodes 100
	$(BIN)/dipn-datagen grasp --out $(DEMO)/data/grasp --episodes 1500 --shard-size 500
	$(BIN)/dipn-train push --data $(DEMO)/data/push --out $(DEMO)/runs/dipn --steps 1000
	$(BIN)/dipn-train grasp-pretrain --data $(DEMO)/data/images --out $(DEMO)/runs/gn-pretrained --steps 200
	$(BIN)/dipn-train grasp --data $(DEMO)/data/grasp --init $(DEMO)/runs/gn-pretrained --out $(DEMO)/runs/gn --steps 500
	$(BIN)/dipn-eval prediction --push-net $(DEMO)/runs/dipn --scenes 200 --out $(DEMO)/eval/prediction
	$(BIN)/dipn-eval grasp --grasp-net $(DEMO)/runs/gn --scenes 100 --out $(DEMO)/eval/grasp
	$(BIN)/dipn-eval clear --push-net $(DEMO)/runs/dipn --grasp-net $(DEMO)/runs/gn --cases hard --candidates 16 --out $(DEMO)/eval/hard
	$(BIN)/dipn-eval clear --push-net $(DEMO)/runs/dipn --grasp-net $(DEMO)/runs/gn --cases random --objects 10 --instances 6 --candidates 16 --out $(DEMO)/eval/random
	$(BIN)/dipn-eval report --prediction $(DEMO)/eval/prediction --grasp $(DEMO)/eval/grasp --hard $(DEMO)/eval/hard --random $(DEMO)/eval/random --runs $(DEMO)/runs/dipn $(DEMO)/runs/gn-pretrained $(DEMO)/runs/gn --out $(DEMO)

test: setup lint
	$(BIN)/python -m pytest

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# ratios, and episodes a second on this machine, for docs/benchmarks.md (30 minutes on 2 idle cores)
bench: setup
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev,bench]'
	$(BIN)/python -m benchmarks all --scale full --out benchmarks.json

clean-demo:
	rm -rf $(DEMO)
