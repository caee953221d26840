# make setup | demo | demo-driving | demo-training | test | test-fast | experiments-test | docs | lint | format | types | bench | body | faults | fuzz | load | soak | model | model-dilemma | robots
PYTHON ?= python3
TORCH ?= torch==2.13.0
VENV := .venv
BIN := $(VENV)/bin

# With a sourced ROS 2 Jazzy its rclpy is used, else the wheels from PyPI.
ifeq ($(ROS_DISTRO),jazzy)
VENV_FLAGS := --system-site-packages
EXTRAS := bags,experiments,figures,test,train,watch
else
EXTRAS := bags,experiments,figures,ros,test,train,watch
endif

.PHONY: setup demo demo-driving demo-training test test-fast experiments-test docs lint format types bench body faults fuzz load soak model model-dilemma robots
.DEFAULT_GOAL := help

.PHONY: help
help:
	@sed -n '1s/# //p' Makefile

setup: $(VENV)/installed

# torch by itself, so that what it names is what is installed.
$(VENV)/installed: setup.py Makefile
	$(PYTHON) -m venv $(VENV_FLAGS) $(VENV)
	$(BIN)/pip install --quiet "setuptools>=64" "$(TORCH)"
	$(BIN)/pip install --quiet --editable ".[$(EXTRAS)]"
	touch $@

demo: setup
	$(BIN)/python examples/demo.py

# A robot learns by driving where it is slow: a film, a picture and a curve.
demo-driving: setup
	$(BIN)/python examples/demo_driving.py $(MISSIONS)

# A robot learns to leave the dead end of the paper's map: a film.
demo-training: setup
	$(BIN)/python examples/demo_training.py $(STEPS)

# One process more than cores, as nodes wait, but four at most; each has a ROS domain of its own.
PROCESSES := $(shell cores=$$(nproc); echo $$((cores < 4 ? cores + 1 : 4)))
PYTEST := $(BIN)/python -m pytest --numprocesses $(PROCESSES) --dist loadfile --no-loadscope-reorder

# Compiled before, by two processes at once: each process of the tests would compile it all.
$(VENV)/compiled: $(VENV)/installed $(wildcard ddqn_planner/*.py ddqn_planner/*/*.py)
	$(BIN)/ddqn-planner warm-up & first=$$!; $(BIN)/ddqn-planner warm-up differential_robot && wait $$first
	touch $@

test: $(VENV)/compiled
	$(PYTEST)

# No ROS and nothing slow: for every save.
test-fast: setup
	$(PYTEST) --ignore test/integration -m "not slow"

# What measures has tests of its own: they train and drive for minutes.
experiments-test: $(VENV)/compiled
	$(PYTEST) --dist worksteal experiments/tests

# The site, in docs/_build/html; a warning is an error.
docs: setup
	$(BIN)/pip install --quiet --editable ".[$(EXTRAS),docs]"
	$(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going --fresh-env docs docs/_build/html

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

types: setup
	$(BIN)/mypy

bench: setup
	$(BIN)/pip install --quiet --editable ".[$(EXTRAS),bench]"
	$(BIN)/python experiments/speed.py; missed=$$?; $(BIN)/python experiments/node_speed.py $(MAP) && exit $$missed

# What a robot's body costs, on MAP (the office by default) and with RADIUS, metres.
body: setup
	$(BIN)/python experiments/body.py $(MAP) $(RADIUS)

# 50 kills, 1,000 inputs of each kind, 10,000 requests, 30 minutes; KILLS, REQUESTS, MINUTES change it.
faults: setup
	$(BIN)/python experiments/faults.py $(KILLS)

fuzz: setup
	$(BIN)/python -m pytest --hypothesis-profile=fuzz --hypothesis-show-statistics -m hypothesis \
		test/grid/test_map_file.py test/model/test_model_file.py \
		test/training/test_run.py test/integration

load: setup
	$(BIN)/python experiments/load.py $(REQUESTS)

soak: setup
	$(BIN)/python experiments/soak.py $(MINUTES)

# These train the shipped models from nothing: the one for any map, and the paper's network.
model: setup
	$(BIN)/ddqn-planner train-any-map --seed 0 --out runs/any_map
	cp runs/any_map/model.safetensors models/any_map.safetensors

model-dilemma: setup
	$(BIN)/ddqn-planner train dilemma --learning-rate 0.001 --seed 1 --out runs/dilemma
	cp runs/dilemma/model.safetensors models/dilemma.safetensors

ROBOT := $(BIN)/ddqn-planner train-robot --resolution 0.05 --seed 0

robots: setup
	$(ROBOT) --motion differential --out models/differential_robot.safetensors \
		--footprint '[[0.45, 0.3], [-0.45, 0.3], [-0.45, -0.3], [0.45, -0.3]]'
	$(ROBOT) --motion ackermann --turning-radius 0.8 --out models/car.safetensors \
		--footprint '[[0.7, 0.3], [-0.2, 0.3], [-0.2, -0.3], [0.7, -0.3]]'
