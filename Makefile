# vn_nav on a machine without ROS: Linux x86-64 and Python 3.11 to 3.14. Each goal sets up what it
# needs. Where ROS 2 Jazzy is installed, the README's `colcon build` is the other way.
#
#   make demo      watch a robot drive to the places of pictures, in simulation, over ROS 2
#                  (SCENE=NAME: in a scene of your own)
#   make test      the fast tests (under 5 minutes)
#   make test-all  every test (under 40 minutes)
#   make soak      faults by the hundred: killed trainings, damaged bags and pictures, lost cameras,
#                  signals, an hour of driving (three hours in all)
#   make lint      ruff, and the linters of ROS
#   make docs      the documentation as a site: build/docs/index.html
#   make figures   every measured figure with its command, and which are older than their code
#                  (CHANGED=1: and the commits since)
#   make clean     remove what was built: the environment, caches, the demonstration's output
#
# Another Python: make PYTHON=python3.12 demo

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
READY_ALL := $(VENV)/.ready-all
READY_DOCS := $(VENV)/.ready-docs
READY_DMLAB := $(VENV)/.ready-dmlab
READY_BROWSER := $(VENV)/.ready-browser
SOURCES := setup.py examples launch test vn_msgs_py vn_nav vn_sim_bridge

# A sourced ROS, or another virtual environment of ROS wheels, shadows ours with its modules,
# libraries and middleware. ROS_DOMAIN_ID stays: it is the user's choice, not an installation's.
SHADOWS := PYTHONPATH PYTHONHOME LD_LIBRARY_PATH CMAKE_PREFIX_PATH RMW_IMPLEMENTATION \
	_ROS_WHEELS_BOOTSTRAP_COMPLETE PIP_USER PIP_TARGET PIP_PREFIX \
	$(filter-out ROS_DOMAIN_ID,$(filter ROS_% AMENT_% COLCON_% CYCLONEDDS_% FASTRTPS_% FASTDDS_%, \
	$(.VARIABLES)))
unexport $(SHADOWS)
export AMENT_PREFIX_PATH := $(CURDIR)/$(VENV)
# Pictures pass whole, and nothing leaves this host (see the profile).
export FASTRTPS_DEFAULT_PROFILES_FILE := $(CURDIR)/config/fastdds_localhost.xml
export FASTDDS_DEFAULT_PROFILES_FILE := $(CURDIR)/config/fastdds_localhost.xml
export ROS_AUTOMATIC_DISCOVERY_RANGE := SYSTEM_DEFAULT

.PHONY: demo test test-all soak lint docs figures clean

demo: $(READY)
	@$(BIN)/vn_nav demo $(if $(SCENE),--scene '$(SCENE)')

# What computes runs side by side, one thread each; then what keeps time over ROS, alone. Both run,
# whatever the first one found. $(call pytest,which,options)
define pytest
	@status=0; \
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m 'not ros$(1)' $(2) -n auto --maxprocesses 8 --dist loadfile || status=$$?; \
	$(BIN)/python -m pytest -m 'ros$(1)' $(2) || status=$$?; \
	exit $$status
endef

test: $(READY)
	$(call pytest, and not slow,--durations=5)

test-all: $(READY_ALL) $(READY_DMLAB) $(READY_BROWSER)
	$(call pytest,,--durations=20)

# `make test-all` kills 20 times.
soak: $(READY)
	@VN_NAV_KILLS=200 $(BIN)/python -m pytest test/learning/test_survival.py test/learning/test_distributed.py \
	 -k 'loses_no_committed_update or torchrun_replaces'
	@VN_NAV_MUTATIONS=50000 $(BIN)/python -m pytest test/bags/test_bag_hostile.py -k mutated
	@VN_NAV_FLIPS=20000 $(BIN)/python -m pytest test/bags/test_bag_flips.py -s
	@mkdir -p runs && VN_NAV_SOAK=1 VN_NAV_FIGURES=runs/safety.jsonl\
	 $(BIN)/python -m pytest test/nodes/test_soak.py -s
	@VN_NAV_PICTURE_MUTATIONS=100000 $(BIN)/python -m pytest test/messages/test_picture_files.py -k mutated

lint: $(READY)
	@$(BIN)/python -m ruff check .
	@$(BIN)/python -m ruff check --target-version py312 --select E9,F .
	@report=$$($(BIN)/ament_flake8 $(SOURCES) 2>&1) || { echo "$$report"; exit 1; }
	@report=$$($(BIN)/ament_pep257 --convention google --add-ignore D101 D102 D103 D105 D107 D417 --\
	 $(SOURCES) 2>&1) || { echo "$$report"; exit 1; }
	@for python in 3.11 3.12; do $(BIN)/python -m mypy --python-version $$python || exit 1; done

# Strict: a link that leads nowhere, or a docstring that cannot be read, is an error.
docs: $(READY_DOCS)
	@$(BIN)/python -m sphinx -b html -W --keep-going -q -d build/docs_cache docs build/docs
	@echo "build/docs/index.html"

figures: $(READY)
	@$(BIN)/python bench/figures.py $(if $(CHANGED),--changed)

clean:
	@rm -rf $(VENV) build install log dist demo docs/generated .pytest_cache .ruff_cache .hypothesis\
	 *.egg-info
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Editable: a change of the sources needs no new set-up. An environment whose Python is gone, or
# that was copied from another folder, is made again from nothing.
$(READY): setup.py constraints.txt
	@[ "$$(uname -s)-$$(uname -m)" = Linux-x86_64 ] || { echo "make needs Linux on x86-64;\
	 this is $$(uname -s) on $$(uname -m): install ROS 2 Jazzy from apt and use colcon (README)" >&2; exit 2; }
	@command -v $(PYTHON) >/dev/null || { echo "make needs Python 3.11 to 3.14;\
	 there is no '$(PYTHON)': apt install python3 python3-venv, or make PYTHON=..." >&2; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))' || {\
	 echo "make needs Python 3.11 to 3.14;\
	 $(PYTHON) is $$($(PYTHON) -V 2>&1): install another and name it, as in make PYTHON=python3.12" >&2; exit 2; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { echo "make needs Python's venv module;\
	 $(PYTHON) has none: apt install python3-venv" >&2; exit 2; }
	@echo "Setting up $(VENV) (ROS 2 Jazzy wheels, PyTorch, tools): once, one to five minutes."
	@[ "$$($(BIN)/python -c 'import pip, sys; print(sys.prefix)' 2>/dev/null)" = "$(CURDIR)/$(VENV)" ]\
	 || $(PYTHON) -m venv --clear $(VENV)
	@$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[ros,train,mesh,grid,onnx,web,test]'
	@touch $@

# The GPU kernels run in Warp's CPU mode too, but only some tests need its 400 MB; or the 280 MB of
# a video encoder and Parquet.
$(READY_ALL): $(READY)
	@$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[gpu,heic,interfaces,lerobot,miniworld,vizdoom]'
	@PIP_CONSTRAINT=constraints.txt $(BIN)/vn_nav simulators install thor >/dev/null
	@touch $@

# DeepMind Lab, in an environment of its own, and its Debian packages where we are root. Where that
# is not possible its tests are skipped, and say why.
$(READY_DMLAB): $(READY) $(wildcard vn_sim_bridge/dmlab/install.py)
	@system=$$([ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && echo --system);\
	 $(BIN)/vn_nav simulators install dmlab $$system || echo "make goes on without DeepMind Lab" >&2
	@touch $@

# A browser for the test of the dashboard, of Debian's packages where we are root.
$(READY_BROWSER): $(READY)
	@command -v chromium >/dev/null || { [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null \
	 && apt-get update -qq >/dev/null && DEBIAN_FRONTEND=noninteractive \
	 apt-get install -y -qq --no-install-recommends chromium >/dev/null 2>&1; } \
	 || echo "make goes on without Chromium: apt install chromium" >&2
	@touch $@

$(READY_DOCS): $(READY)
	@$(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[docs]'
	@touch $@
