# make demo   a virtual environment of its own, then the main job on the bundled model and the bundled sample
# make test   the gate: lint, format, strict types, import direction, tests with a branch-coverage floor
# Others: lint, model and head (simulate, train, measure), evaluate, reproduction (the paper's table), detection-suite,
# detection-ablations, detection-robustness, internal-sizes, thin-structures, benchmark, wheel, audit (known vulnerabilities), sbom, clean, distclean. Needs Python >= 3.11, make and git;
# fetches from package indexes only.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := demo

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
# Holds for the packages that build ours, too.
export PIP_CONSTRAINT := constraints.txt
# On Linux this index has the CPU build of torch (200 MB); PyPI's is a CUDA build of gigabytes.
TORCH_CPU_INDEX ?= https://download.pytorch.org/whl/cpu

DEMO_SAMPLE ?= samples/drone
DEMO_OUT ?= demo-output
COVERAGE_FLOOR ?= 90
# Each may load a model of its own.
TEST_PROCESSES ?= 4
# In an environment of their own, so that neither is part of what it looks at.
AUDIT := $(VENV)/audit
AUDIT_TOOLS := pip-audit==2.10.1 cyclonedx-bom==7.5.0

# The recipe of the bundled model: seeds, sizes and steps. Held-out seeds are never trained on.
MODEL_DIR ?= runs/model
MODEL_SEQUENCES ?= 360
MODEL_FRAMES ?= 32
MODEL_STEPS ?= 15000
MODEL_JOBS ?= 2
MODEL_THREADS ?= 1
MODEL_TRAINING := --set model.preset=calibrated --set training.learning_rate=0.0015 --set training.warmup_steps=200 \
  --set training.validate_every=5000
HEAD_STEPS ?= 18000
# Whose bundled head the training begins with.
HEAD_INIT_COMMIT ?= 3f3a53db40e8
# How much of it stays in the finished weights.
HEAD_INIT_SHARE ?= 0.3
HEAD_THREADS ?= 2
REPRODUCTION_DIR ?= runs/reproduction
HELD_OUT_SEQUENCES ?= 12
HELD_OUT_FRAMES ?= 20

.PHONY: demo test lint model head held-out evaluate reproduction detection-suite detection-ablations detection-robustness internal-sizes thin-structures \
  benchmark \
  wheel audit sbom clean distclean

$(VENV)/.torch: constraints.txt
	@echo 'making $(VENV) with torch (once, some minutes)'
	@python=; for name in $(PYTHON) python3.11 python3 python3.12 python3.13; do \
	  if $$name -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then python=$$name; break; fi; \
	done; \
	[[ -n "$$python" ]] || { echo "error: expected Python 3.11 or later as python3.11 or python3; name another one with: make PYTHON=/path/to/python3" >&2; exit 1; }; \
	[[ -x $(BIN)/python ]] || "$$python" -m venv $(VENV) || { rm -rf $(VENV); exit 1; }
	@index=; \
	if [[ "$$(uname -s)" == Linux ]] && $(BIN)/python -c "import urllib.request as u; u.urlopen('$(TORCH_CPU_INDEX)/torch/', timeout=5)" 2>/dev/null; \
	then index="--extra-index-url $(TORCH_CPU_INDEX)"; fi; \
	$(PIP) install --quiet $$index torch
	@touch $@

$(VENV)/.installed: $(VENV)/.torch pyproject.toml
	$(PIP) install --quiet --editable '.[openvino]'
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(PIP) install --quiet --editable '.[dev]'
	@touch $@

demo: $(VENV)/.installed
	$(BIN)/viflow-anomaly batch $(DEMO_SAMPLE) --out $(DEMO_OUT) --overwrite --overlays all
	$(BIN)/python .ci/show_demo.py $(DEMO_OUT)

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

test: $(VENV)/.installed-dev
	.ci/system-packages
	$(MAKE) --no-print-directory lint
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses $(TEST_PROCESSES) --dist loadfile \
	  --cov --cov-branch --cov-report=term --cov-fail-under=$(COVERAGE_FLOOR)

wheel: $(VENV)/.installed
	rm -rf build dist
	$(PIP) wheel --quiet --no-deps --wheel-dir dist .
	$(BIN)/python .ci/check_wheel.py dist/*.whl

$(AUDIT)/.installed: $(VENV)/.torch
	$(BIN)/python -m venv $(AUDIT)
	$(AUDIT)/bin/python -m pip --disable-pip-version-check install --quiet $(AUDIT_TOOLS)
	@touch $@

# Every pin, against PyPI's list of known vulnerabilities; one that cannot be looked up fails, too.
audit: $(AUDIT)/.installed
	$(AUDIT)/bin/pip-audit --strict --progress-spinner off --no-deps --disable-pip --requirement constraints.txt

# What is installed in $(VENV), as CycloneDX.
sbom: $(AUDIT)/.installed $(VENV)/.installed
	mkdir -p dist
	$(AUDIT)/bin/cyclonedx-py environment --pyproject pyproject.toml --output-reproducible \
	  --output-file dist/sbom.cdx.json $(BIN)/python

model: held-out
	for rig in drone:10000 car:50000; do \
	  $(BIN)/viflow-anomaly simulate --rig $${rig%:*} --seed $${rig#*:} --sequences $(MODEL_SEQUENCES) \
	    --frames $(MODEL_FRAMES) --jobs $(MODEL_JOBS) --out $(MODEL_DIR)/train --set simulator.ground_truth=false >/dev/null; \
	done
	validation=; for folder in $(MODEL_DIR)/held-out/*_9?000[0-5]; do validation+=" --validation $$folder"; done; \
	$(BIN)/viflow-anomaly train $(MODEL_DIR)/train/* $$validation --out $(MODEL_DIR)/run --resume \
	  --steps $(MODEL_STEPS) --threads $(MODEL_THREADS) $(MODEL_TRAINING)
	$(BIN)/viflow-anomaly export --checkpoint $(MODEL_DIR)/run/model.safetensors
	for kind in safetensors json onnx; do cp $(MODEL_DIR)/run/model.$$kind viflow_anomaly/weights/viflow-calibrated.$$kind; done
	$(MAKE) --no-print-directory evaluate

# The bundled evidence head, for the bundled network, from the one before it: 1,301 simulated sequences with ground truth
# (8 GB, 20 minutes on two cores), their cues (8 GB of memory, 10 minutes), then 60 minutes of training on two threads.
head: held-out
	simulate() { $(BIN)/viflow-anomaly simulate --rig $$1 --seed $$2 --sequences $$3 --frames $$4 --jobs $(MODEL_JOBS) \
	  --out $(MODEL_DIR)/$$5 "$${@:6}" >/dev/null; }; \
	simulate drone 30000 179 16 head; simulate drone 30200 200 16 head; simulate drone 32000 256 12 head; \
	simulate drone 31000 12 10 head --set simulator.width=752 --set simulator.height=480; \
	simulate drone 33000 30 12 head --set simulator.thin_structures=24; \
	simulate car 80000 60 16 head; simulate car 80200 100 16 head; simulate car 82000 90 12 head; \
	simulate car 81000 24 10 head --set simulator.width=832 --set simulator.height=256; \
	simulate car 83000 30 12 head --set simulator.thin_structures=80; \
	simulate drone 36000 60 12 head --set simulator.foliage=16; \
	simulate drone 36200 30 8 head --set simulator.width=752 --set simulator.height=480 --set simulator.foliage=12; \
	simulate drone 36300 70 12 head --set 'simulator.movers=[3,8]'; \
	simulate car 86000 30 6 head --set simulator.width=1242 --set simulator.height=375 --set simulator.foliage=60; \
	simulate car 86100 40 8 head --set simulator.width=832 --set simulator.height=256 --set simulator.foliage=50; \
	simulate car 86300 60 12 head --set simulator.foliage=50; \
	simulate car 86500 30 8 head --set simulator.width=1242 --set simulator.height=375; \
	simulate drone 35000 50 7 head-calibration; simulate car 85000 50 7 head-calibration; \
	simulate drone 35500 12 12 head-calibration --set simulator.thin_structures=24; \
	simulate car 85500 12 12 head-calibration --set simulator.thin_structures=80; \
	simulate drone 35800 16 8 head-calibration --set simulator.foliage=16; \
	simulate drone 35900 10 6 head-calibration --set simulator.width=752 --set simulator.height=480; \
	simulate car 85800 16 8 head-calibration --set simulator.foliage=50; \
	simulate car 85900 12 6 head-calibration --set simulator.width=832 --set simulator.height=256 \
	  --set simulator.foliage=50; \
	simulate car 87000 12 6 head-calibration --set simulator.width=1242 --set simulator.height=375 \
	  --set simulator.foliage=60; \
	simulate car 87100 12 6 head-calibration --set simulator.width=1242 --set simulator.height=375
	mkdir -p $(MODEL_DIR)/head-init
	for kind in safetensors json; do \
	  git show $(HEAD_INIT_COMMIT):viflow_anomaly/weights/viflow-evidence.$$kind >$(MODEL_DIR)/head-init/head.$$kind; \
	done
	$(BIN)/viflow-anomaly train-evidence $(MODEL_DIR)/head/* --calibration $(MODEL_DIR)/head-calibration \
	  --out $(MODEL_DIR)/head-run --resume \
	  --init $(MODEL_DIR)/head-init/head.safetensors --steps $(HEAD_STEPS) --threads $(HEAD_THREADS) \
	  --set evidence_training.init_share=$(HEAD_INIT_SHARE)
	$(BIN)/viflow-anomaly export --evidence-head $(MODEL_DIR)/head-run/evidence.safetensors
	for kind in safetensors json onnx; do cp $(MODEL_DIR)/head-run/evidence.$$kind viflow_anomaly/weights/viflow-evidence.$$kind; done
	$(MAKE) --no-print-directory evaluate

held-out: $(VENV)/.installed-dev
	for rig in drone:900000 car:950000; do \
	  $(BIN)/viflow-anomaly simulate --rig $${rig%:*} --seed $${rig#*:} --sequences $(HELD_OUT_SEQUENCES) \
	    --frames $(HELD_OUT_FRAMES) --jobs $(MODEL_JOBS) --out $(MODEL_DIR)/held-out >/dev/null; \
	done

evaluate: held-out
	$(BIN)/viflow-anomaly evaluate flow $(MODEL_DIR)/held-out/* --out benchmarks/results/endpoint-error.json
	$(BIN)/viflow-anomaly evaluate detect $(MODEL_DIR)/held-out/* --out benchmarks/results/detection.json

# Two hours and a half on two idle cores, 20 GB below REPRODUCTION_DIR's disk are plenty; stopped, it goes on.
reproduction: $(VENV)/.installed-dev
	simulate() { $(BIN)/viflow-anomaly simulate --rig $$1 --seed $$2 --sequences $$3 --frames $$4 --jobs $(MODEL_JOBS) \
	  --out $(REPRODUCTION_DIR)/$$5 "$${@:6}" >/dev/null; }; \
	simulate drone 10000 360 32 train --set simulator.ground_truth=false; \
	simulate car 50000 660 32 train --set simulator.ground_truth=false; \
	simulate drone 900000 12 20 held-out; \
	simulate car 950000 12 20 held-out; \
	simulate drone 70000 4 600 split
	$(BIN)/python benchmarks/reproduction.py --data $(REPRODUCTION_DIR) --out benchmarks/results/reproduction \
	  --jobs $(MODEL_JOBS) --checkpoint bundled=viflow_anomaly/weights/viflow-calibrated.safetensors

# Regions of the bundled model: on sequences of fixed seeds of their own, and what each step of the detector is worth.
detection-suite: $(VENV)/.installed-dev
	$(BIN)/python benchmarks/detection_suite.py --jobs $(MODEL_JOBS)

detection-ablations: held-out
	$(BIN)/python benchmarks/detection_ablations.py $(MODEL_DIR)/held-out/*

# What a wrong calibration costs: time offset, mounting, gyro bias, focal length, noise, brightness.
detection-robustness: held-out
	$(BIN)/python benchmarks/detection_robustness.py $(MODEL_DIR)/held-out/*

# What judging large pictures at a smaller size costs and saves; times are meant for an idle machine.
internal-sizes: $(VENV)/.installed-dev
	$(BIN)/python benchmarks/internal_sizes.py --jobs $(MODEL_JOBS)

# False alarms on railings, bare trees, poles and wires, where nothing moves by itself.
thin-structures: $(VENV)/.installed-dev
	$(BIN)/python benchmarks/thin_structures.py --jobs $(MODEL_JOBS)

# What a pair, a recording and a start cost on this machine; some minutes, meant for an idle one.
benchmark: $(VENV)/.installed-dev
	$(BIN)/viflow-anomaly benchmark --threads 1,2 --curves --out benchmarks/results/benchmark
	$(BIN)/python benchmarks/batch_throughput.py
	$(BIN)/python benchmarks/startup.py

clean:
	rm -rf build dist $(DEMO_OUT) .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis .coverage

distclean: clean
	rm -rf $(VENV)
