# make demo   set up, then generate, train, clear tables and write demo/report.html (10 minutes on 2 cores)
# make test   lint, types, tests
# make bench  the figures of docs/benchmarks.md
# make push-figures, make grasp-figures, make clear-figures  those of docs/push-prediction.md, grasping.md, clearing.md
PYTHON ?= python3
BIN := .venv/bin
DEMO := demo

.PHONY: setup demo test lint bench push-figures grasp-figures clear-figures clean-demo

setup: .venv/.installed

.venv/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

demo: setup
	$(BIN)/dipn-datagen push --out $(DEMO)/data/push --episodes 1500
	$(BIN)/dipn-datagen images --out $(DEMO)/data/images --episodes 100
	$(BIN)/dipn-train grasp-pretrain --data $(DEMO)/data/images --out $(DEMO)/runs/gn-pretrained --steps 200
	$(BIN)/dipn-datagen grasp --grasp-net $(DEMO)/runs/gn-pretrained --out $(DEMO)/data/grasp --objects 1:10 --episodes 1500 --shard-size 500
	$(BIN)/dipn-train push --data $(DEMO)/data/push --out $(DEMO)/runs/dipn --steps 1000
	$(BIN)/dipn-train grasp --data $(DEMO)/data/grasp --init $(DEMO)/runs/gn-pretrained --out $(DEMO)/runs/gn --steps 500
	$(BIN)/dipn-eval prediction --push-net $(DEMO)/runs/dipn --scenes 200 --out $(DEMO)/eval/prediction
	$(BIN)/dipn-eval grasp --grasp-net $(DEMO)/runs/gn --scenes 40 --out $(DEMO)/eval/grasp
	$(BIN)/dipn-eval clear --push-net $(DEMO)/runs/dipn --grasp-net $(DEMO)/runs/gn --cases hard --candidates 16 --out $(DEMO)/eval/hard
	$(BIN)/dipn-eval clear --push-net $(DEMO)/runs/dipn --grasp-net $(DEMO)/runs/gn --cases random --objects 10 --instances 6 --candidates 16 --out $(DEMO)/eval/random
	$(BIN)/dipn-eval report --prediction $(DEMO)/eval/prediction --grasp $(DEMO)/eval/grasp --clear $(DEMO)/eval/hard $(DEMO)/eval/random --runs $(DEMO)/runs/dipn $(DEMO)/runs/gn-pretrained $(DEMO)/runs/gn --out $(DEMO)

test: setup lint
	$(BIN)/python -m pytest

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# ratios, and episodes a second on this machine, for docs/benchmarks.md (hours on 2 idle cores)
bench: setup
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev,bench]'
	$(BIN)/python -m benchmarks all --scale full --out benchmarks.json

# learning curves and everything else on docs/push-prediction.md (hours on 2 cores; data and trainings go on where they stopped)
PUSH := results/push
TRAIN_PUSH := $(BIN)/dipn-train push --data $(PUSH)/data --eval-every 1000 --save-every 1000
SHIFT := $(BIN)/dipn-eval prediction --push-net builtin --scenes 500 --no-segmented
UNSEEN := $(BIN)/dipn-eval prediction --scenes 500 --objects paper --no-segmented
push-figures: setup
	$(BIN)/dipn-datagen push --out $(PUSH)/data --episodes 52000
	for seed in 0 1 2; do for run in 100:600 300:1000 500:1500 1000:2500 1500:3000 51000:10000; do \
	  $(TRAIN_PUSH) --limit $${run%:*} --steps $${run#*:} --seed $$seed --out $(PUSH)/runs/$${run%:*}-$$seed || exit; \
	done; done
	$(BIN)/dipn-eval prediction --curve $(PUSH)/runs/* --scenes 1000 --objects paper --out $(PUSH)/curve
	$(TRAIN_PUSH) --limit 1500 --steps 3000 --centimetres 5 --out $(PUSH)/only5
	$(TRAIN_PUSH) --limit 1500 --steps 3000 --centimetres 10 --out $(PUSH)/only10
	$(TRAIN_PUSH) --limit 1500 --steps 3000 --masks found --out $(PUSH)/found
	for run in every:runs/1500-0 only5:only5 only10:only10 found:found; do \
	  $(BIN)/dipn-eval prediction --push-net $(PUSH)/$${run#*:} --scenes 500 --objects paper --no-physics --out $(PUSH)/alone-$${run%:*} || exit; \
	done
	$(SHIFT) --objects paper --out $(PUSH)/shift-none
	$(SHIFT) --objects paper --density 1000 1500 --out $(PUSH)/shift-heavier
	$(SHIFT) --objects paper --density 100 200 --out $(PUSH)/shift-lighter
	$(SHIFT) --objects paper --friction 0.1 0.2 --out $(PUSH)/shift-slipperier
	$(SHIFT) --objects paper --friction 0.5 0.7 --out $(PUSH)/shift-stickier
	$(SHIFT) --objects 8:15 --out $(PUSH)/shift-crowded
	for run in "cuboid:cuboid_half cuboid_flat cuboid_long cube cuboid_mid cuboid_square" "cylinder:cylinder cylinder_flat" \
	  "half_cylinder:half_cylinder half_cylinder_large" "triangular_prism:triangle triangle_flat" "concave:concave concave_slim"; do \
	  $(TRAIN_PUSH) --limit 1500 --steps 3000 --without $${run%:*} --out $(PUSH)/no-$${run%:*} || exit; \
	  $(UNSEEN) --items $${run#*:} --push-net $(PUSH)/no-$${run%:*} --out $(PUSH)/without-$${run%:*} || exit; \
	  $(UNSEEN) --items $${run#*:} --push-net $(PUSH)/runs/1500-0 --no-physics --out $(PUSH)/with-$${run%:*} || exit; \
	done
	$(BIN)/dipn-datagen push --out $(PUSH)/crowds --objects 8:15 --episodes 6600
	$(BIN)/dipn-train push --data $(PUSH)/crowds --limit 1500 --steps 3000 --out $(PUSH)/crowd
	for run in crowded:crowd few:runs/1500-0; do \
	  $(BIN)/dipn-eval prediction --scenes 500 --objects 8:15 --no-segmented --no-physics --push-net $(PUSH)/$${run#*:} --out $(PUSH)/crowd-$${run%:*} || exit; \
	done
	$(BIN)/python docs/push_prediction.py $(PUSH)

# learning curves, the network that comes with the package, and everything else on docs/grasping.md (two hours on 2 cores)
GRASP := results/grasp
GUIDED := $(BIN)/dipn-datagen grasp --actions
PACKED := $(GUIDED) 8 --objects
MORE := $(BIN)/dipn-train grasp --batch 64 --data $(GRASP)/first $(GRASP)/second
NO_ARCHES := triangle cuboid_half cuboid_flat cuboid_long cube half_cylinder cylinder cylinder_flat half_cylinder_large cuboid_mid cuboid_square triangle_flat
grasp-figures: setup
	$(BIN)/dipn-datagen images --out $(GRASP)/images --episodes 100
	$(BIN)/dipn-train grasp-pretrain --data $(GRASP)/images --out $(GRASP)/pretrained --steps 400
	for seed in 0 1 2 3 4 5 6 7; do \
	  $(BIN)/dipn-train grasp-online --init $(GRASP)/pretrained --seed $$seed --grasps 400 --out $(GRASP)/runs/with-$$seed || exit; \
	done
	for seed in 0 1 2; do \
	  $(BIN)/dipn-train grasp-online --seed $$seed --grasps 400 --out $(GRASP)/runs/without-$$seed || exit; \
	done
	$(BIN)/dipn-eval grasp --curve $(GRASP)/runs/* --out $(GRASP)/online
	$(GUIDED) 6 --objects 1:12 --episodes 12000 --grasp-net $(GRASP)/pretrained --out $(GRASP)/first
	$(BIN)/dipn-train grasp --data $(GRASP)/first --init $(GRASP)/pretrained --steps 1500 --batch 64 --learning-rate 2e-3 --out $(GRASP)/once
	$(GUIDED) 8 --objects 1:20 --episodes 6000 --seed 1 --grasp-net $(GRASP)/once --guided 0.6 --hard 0.3 --out $(GRASP)/second
	$(BIN)/dipn-train grasp --data $(GRASP)/first $(GRASP)/second --init $(GRASP)/pretrained --steps 2500 --batch 64 --learning-rate 2e-3 --out $(GRASP)/twice
	$(PACKED) 3:8 --packed 1 --episodes 9000 --seed 5 --grasp-net $(GRASP)/twice --guided 0.6 --hard 0.3 --out $(GRASP)/third
	$(MORE) $(GRASP)/third --init $(GRASP)/pretrained --steps 3500 --learning-rate 2e-3 --out $(GRASP)/thrice
	$(PACKED) 3:8 --packed 1 --episodes 8000 --seed 7 --grasp-net $(GRASP)/thrice --guided 0.7 --hard 0.25 --out $(GRASP)/fourth
	$(MORE) $(GRASP)/third $(GRASP)/fourth --init $(GRASP)/thrice --steps 3000 --learning-rate 1.5e-3 --out $(GRASP)/fourfold
	$(PACKED) 3:9 --packed 0.8 --episodes 6000 --seed 9 --grasp-net $(GRASP)/fourfold --guided 0.7 --hard 0.25 --out $(GRASP)/fifth
	$(MORE) $(GRASP)/third $(GRASP)/fourth $(GRASP)/fifth --init $(GRASP)/fourfold --steps 2200 --learning-rate 1e-3 --out $(GRASP)/shipped
	$(BIN)/dipn-eval grasp --grasp-net $(GRASP)/shipped --scenes 200 --others 16 --out $(GRASP)/builtin-10
	$(BIN)/dipn-eval grasp --grasp-net $(GRASP)/shipped --scenes 30 --objects 30 --others 16 --out $(GRASP)/builtin-30
	$(BIN)/dipn-datagen images --items $(NO_ARCHES) --out $(GRASP)/no-arches/images --episodes 100
	$(BIN)/dipn-train grasp-pretrain --data $(GRASP)/no-arches/images --out $(GRASP)/no-arches/pretrained --steps 400
	$(GUIDED) 6 --items $(NO_ARCHES) --objects 1:12 --episodes 5000 --grasp-net $(GRASP)/no-arches/pretrained --out $(GRASP)/no-arches/grasps
	$(BIN)/dipn-train grasp --data $(GRASP)/no-arches/grasps --init $(GRASP)/no-arches/pretrained --steps 800 --batch 64 --learning-rate 2e-3 --out $(GRASP)/no-arches/gn
	$(BIN)/dipn-eval grasp --grasp-net $(GRASP)/no-arches/gn --scenes 50 --items concave concave_slim --others 16 --out $(GRASP)/unseen-concave
	$(BIN)/python docs/grasping.py $(GRASP)

# the methods compared, with the samples that the paper gives them and with the shipped networks, on docs/clearing.md
# (hours on 2 cores; needs push-figures' data and grasp-figures' pre-trained network)
CLEAR := results/clear
ON := results/clear/table
BASELINE := $(BIN)/dipn-train baseline --method
TABLES := hard:--cases_hard_--instances_30 30:--cases_random_--objects_30_--instances_30 10:--cases_random_--objects_10_--instances_30
FEWER := hard:--cases_hard_--instances_30 30:--cases_random_--objects_30_--instances_10
clear-figures: setup
	$(BIN)/dipn-train grasp-online --init $(GRASP)/pretrained --grasps 500 --out $(CLEAR)/gn
	$(BIN)/dipn-train push --data $(PUSH)/data --limit 1500 --steps 3000 --out $(CLEAR)/dipn
	$(BIN)/dipn-train push --data $(PUSH)/data --limit 2000 --steps 3000 --out $(CLEAR)/dipn-2000
	$(BASELINE) dqn --actions 1500 --grasp-net $(CLEAR)/gn --out $(CLEAR)/dqn
	$(BASELINE) rea --actions 1500 --out $(CLEAR)/rea
	$(BASELINE) vpg --actions 2500 --out $(CLEAR)/vpg
	for each in $(TABLES); do \
	  on=$${each%%:*}; tables=$$(echo $${each#*:} | tr _ ' '); paper="$(BIN)/dipn-eval clear $$tables --label paper"; \
	  $(BIN)/dipn-eval clear $$tables --label large --push-net builtin --grasp-net builtin --out $(ON)/large-$$on || exit; \
	  $$paper --push-net $(CLEAR)/dipn --grasp-net $(CLEAR)/gn --out $(ON)/dipn-gn-$$on || exit; \
	  $$paper --method vpg --value-net $(CLEAR)/vpg --out $(ON)/vpg-$$on || exit; \
	  $$paper --method rea+dipn --push-net $(CLEAR)/dipn-2000 --value-net $(CLEAR)/rea --out $(ON)/rea-dipn-$$on || exit; \
	  $$paper --method dqn+gn --value-net $(CLEAR)/dqn --grasp-net $(CLEAR)/gn --out $(ON)/dqn-gn-$$on || exit; \
	done
	$(BASELINE) dqn --actions 3000 --grasp-net builtin --out $(CLEAR)/dqn-large
	$(BASELINE) rea --actions 3000 --out $(CLEAR)/rea-large
	$(BASELINE) vpg --actions 4000 --out $(CLEAR)/vpg-large
	for each in $(FEWER); do \
	  on=$${each%%:*}; tables=$$(echo $${each#*:} | tr _ ' '); large="$(BIN)/dipn-eval clear $$tables --label large"; \
	  $$large --method vpg --value-net $(CLEAR)/vpg-large --out $(ON)/vpg-large-$$on || exit; \
	  $$large --method rea+dipn --push-net builtin --value-net $(CLEAR)/rea-large --out $(ON)/rea-dipn-large-$$on || exit; \
	  $$large --method dqn+gn --value-net $(CLEAR)/dqn-large --grasp-net builtin --out $(ON)/dqn-gn-large-$$on || exit; \
	  $$large --method gn --grasp-net builtin --out $(ON)/gn-only-$$on || exit; \
	  $$large --method physics+gn --grasp-net builtin --out $(ON)/physics-gn-$$on || exit; \
	done
	$(BIN)/dipn-eval clear --cases hard --instances 30 --label paper --method gn --grasp-net $(CLEAR)/gn --out $(ON)/gn-paper-hard
	$(BIN)/dipn-eval clear --cases hard --instances 30 --label unguarded --no-cautious --no-remember --push-net builtin --grasp-net builtin --out $(ON)/unguarded-hard
	$(BIN)/dipn-eval report --clear $(ON)/* --out $(CLEAR)
	$(BIN)/dipn-eval sweep --push-net builtin --grasp-net builtin --distances 0.03:0.12:0.01 --instances 3 --out $(CLEAR)/sweep
	$(BIN)/python docs/clearing.py $(ON) $(CLEAR)/sweep

clean-demo:
	rm -rf $(DEMO)
