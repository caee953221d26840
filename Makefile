# make setup | demo | demo-driving | demo-training | test | test-fast | coverage | experiments-test | docs | lint | format | types | constraints | bench | body | faults | fuzz | load | soak | model | model-dilemma | robots
PYTHON ?= python3
# What pip is asked for. PyPI's builds for Linux bring CUDA. The CPU build alone:
# make setup TORCH="torch==2.13.0 --index-url https://download.pytorch.org/whl/cpu"
TORCH ?= torch==2.13.0
VENV := .venv
BIN := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check

.PHONY: setup demo demo-driving demo-training test test-fast coverage experiments-test docs lint format types constraints bench body faults fuzz load soak model model-dilemma robots
.DEFAULT_GOAL := help

.PHONY: help
help:
	@sed -n '1s/# //p' Makefile

# The environment grows in stages, each a file in it: a demo does not wait for torch.
setup: $(VENV)/full

# To plan and to draw. A sourced ROS 2 is used, else Jazzy's wheels from PyPI.
$(VENV)/base: setup.py tools/environment.py
	@extras=$$($(PYTHON) tools/environment.py $(VENV)) && \
		echo "installing $$extras into $(VENV); a new one downloads about 190 MB" && \
		$(INSTALL) --editable ".[$$extras]"
	@touch $@

# torch by itself, so that what it names is what is installed.
$(VENV)/train: $(VENV)/base Makefile
	@echo "installing $(TORCH), for training"
	@$(INSTALL) $(TORCH)
	@$(INSTALL) --editable ".[train]"
	@touch $@

# With setuptools for the tests that build the package.
$(VENV)/full: $(VENV)/train
	@echo "installing what tests and experiments need"
	@$(INSTALL) "setuptools>=64" --editable ".[bags,experiments,lint,test]"
	@touch $@

$(VENV)/docs $(VENV)/bench: $(VENV)/full
	@echo "installing what $(@F) needs"
	@$(INSTALL) --editable ".[$(@F)]"
	@touch $@

demo: $(VENV)/base
	$(BIN)/python examples/demo.py

# A robot learns by driving where it is slow: a film, a picture and a curve.
demo-driving: $(VENV)/base
	$(BIN)/python examples/demo_driving.py $(MISSIONS)

# A robot learns to leave the dead end of the paper's map: a film.
demo-training: $(VENV)/train
	$(BIN)/python examples/demo_training.py $(STEPS)

# One process more than cores, as nodes wait, but four at most; each has a ROS domain of its own.
PROCESSES := $(shell cores=$$(nproc); echo $$((cores < 4 ? cores + 1 : 4)))
PYTEST := $(BIN)/python -m pytest --numprocesses $(PROCESSES) --dist loadfile --no-loadscope-reorder

# Compiled before, by two processes at once: each process of the tests would compile it all.
$(VENV)/compiled: $(VENV)/full $(wildcard ddqn_planner/*.py ddqn_planner/*/*.py)
	rm -rf $(VENV)/trained
	{ $(BIN)/ddqn-planner warm-up && \
		$(BIN)/ddqn-planner train dilemma --steps 300 --filters 4 --out $(VENV)/trained; } & first=$$!; \
		$(BIN)/ddqn-planner warm-up differential_robot && wait $$first
	touch $@

# Else each of some 200 processes compiles the modules that it imports.
test test-fast coverage experiments-test: export PYTHONDONTWRITEBYTECODE :=

test: $(VENV)/compiled
	$(PYTEST)

# No ROS and nothing slow: for every save.
test-fast: setup
	$(PYTEST) --ignore test/integration -m "not slow"

# Which lines and branches the fast tests run, as a table, without compiled functions and
# nodes.
coverage: setup
	$(PYTEST) --ignore test/integration -m "not slow" --cov --cov-report term-missing:skip-covered

# What measures has tests of its own: they train and drive for minutes.
experiments-test: $(VENV)/compiled
	$(PYTEST) --dist worksteal experiments/tests

# The site, in docs/_build/html; a warning is an error.
docs: $(VENV)/docs
	$(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going --fresh-env docs docs/_build/html

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# ROS's messages have no types. Their stubs, without which mypy takes messages for Any, go to typings/.
types: setup
	$(BIN)/python tools/message_types.py typings
	$(BIN)/mypy

# The versions of the libraries and tools in .venv; `PIP_CONSTRAINT=constraints.txt make setup` installs them.
constraints: setup
	$(BIN)/python tools/constraints.py > constraints.txt

bench: $(VENV)/bench
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

# These train the shipped models from nothing: the one for any map, the paper's network, and,
# without torch, two robots.
model: $(VENV)/train
	$(BIN)/ddqn-planner train-any-map --seed 0 --out runs/any_map
	cp runs/any_map/model.safetensors models/any_map.safetensors

model-dilemma: $(VENV)/train
	$(BIN)/ddqn-planner train dilemma --seed 1 --out runs/dilemma
	cp runs/dilemma/model.safetensors models/dilemma.safetensors

ROBOT := $(BIN)/ddqn-planner train-robot --resolution 0.05 --seed 0

robots: $(VENV)/base
	$(ROBOT) --motion differential --out models/differential_robot.safetensors \
		--footprint '[[0.45, 0.3], [-0.45, 0.3], [-0.45, -0.3], [0.45, -0.3]]'
	$(ROBOT) --motion ackermann --turning-radius 0.8 --out models/car.safetensors \
		--footprint '[[0.7, 0.3], [-0.2, 0.3], [-0.2, -0.3], [0.7, -0.3]]'
