# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
# make demo, make test: see README.md. Everything that is installed goes into .venv*.
BAG ?= bags/plate
OUT ?= out/demo

# that of the bag's name, or of its name up to the first underscore, or the plate's
bag := $(basename $(notdir $(BAG:/=)))
configs := $(bag) $(firstword $(subst _, ,$(bag))) plate
CONFIG ?= $(firstword $(wildcard $(configs:%=config/%.yaml)))

export PYTHON
export ROS_AUTOMATIC_DISCOVERY_RANGE := LOCALHOST
# With ROS sourced, pytest would load ROS's plugins, which do not fit every pytest.
export PYTEST_DISABLE_PLUGIN_AUTOLOAD := 1
# A test that hangs fails, with the place where it hangs, wherever that is: the process of the
# worker is ended, and another goes on. What failed is told at once.
PYTEST := -m pytest -p xdist --dist worksteal -p pytest_instafail --instafail \
    -p pytest_timeout --timeout 200 --timeout-method thread
# The workers share the processors; the matrices are small.
export OPENBLAS_NUM_THREADS := 1
# What the ROS wheels set for a process of theirs must not reach another environment's.
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE

# Tests of nodes mostly wait for each other, so there are three workers to two processors.
WORKERS := $$((3 * $$(nproc) / 2))
# whose kernels OpenBLAS uses; also tried before a release: PROCESSORS='Haswell Zen SkylakeX'
PROCESSORS ?= Haswell

.PHONY: demo test test-all test-oldest test-newest tf2_msgs lint figures docs clean

demo:
	@tools/environment.sh .venv ros
	.venv/bin/python tools/demo.py --bag '$(BAG)' --config '$(CONFIG)' --out '$(OUT)'

# Every part of the product, in the environment of the demo; without the long tests, and with
# fewer examples of each property.
test:
	@tools/environment.sh .venv ros,kinematics,test
	@$(MAKE) --no-print-directory tf2_msgs || true  # the last line of the tests says what is missing
	HYPOTHESIS_PROFILE=$${HYPOTHESIS_PROFILE:-fewer} \
	    .venv/bin/python $(PYTEST) -n $(WORKERS) -m 'not thorough' $(PYTEST_OPTIONS)

# All tests, with the newest libraries and the oldest; what fails hides nothing of the rest.
test-all:
	@status=0; for part in test-newest test-oldest; do \
	    $(MAKE) --no-print-directory $$part || status=1; done; exit $$status

test-newest:
	@tools/environment.sh .venv ros,kinematics,batch,test,dev
	@$(MAKE) --no-print-directory tf2_msgs || true
	.venv/bin/python $(PYTEST) -n $(WORKERS) $(PYTEST_OPTIONS)

# The core, without ROS, against the libraries of a Jazzy install;
# without the tests that solve many times, which call nothing that the others do not call, and
# without those that no version of numpy or scipy can change.
test-oldest:
	@tools/environment.sh .venv-oldest test requirements/jazzy.txt
	@status=0; for core in $(PROCESSORS); do \
	    echo "OPENBLAS_CORETYPE=$$core"; \
	    OPENBLAS_CORETYPE=$$core HYPOTHESIS_PROFILE=$${HYPOTHESIS_PROFILE:-fewer} \
	    .venv-oldest/bin/python $(PYTEST) -n $$(nproc) -q \
	    -m 'not ros and not thorough and not once' $(PYTEST_OPTIONS) || status=1; done; \
	exit $$status

# The wheels lack it; with it, the node publishes /tf_static. Needs gcc, g++, Python's headers.
tf2_msgs:
	@tools/environment.sh .venv ros
	@.venv/bin/python -c 'import tf2_msgs.msg' 2>/dev/null || \
	    .venv/bin/python tools/build_interfaces.py test/interfaces/tf2_msgs

lint:
	@tools/environment.sh .venv ros,kinematics,test,dev
	.venv/bin/ruff check
	.venv/bin/flake8
	.venv/bin/mypy
	.venv/bin/lint-imports

# What the documentation draws and lists from the code.
figures:
	@tools/environment.sh .venv ros,kinematics,test,dev
	.venv/bin/python tools/draw_targets.py
	.venv/bin/python tools/draw_demo.py
	.venv/bin/python tools/make_reference.py

# The pages of docs/ as a site; a link that leads nowhere is an error.
docs:
	@tools/environment.sh .venv docs
	.venv/bin/mkdocs build --quiet --strict --site-dir out/site
	@echo "wrote $(CURDIR)/out/site/index.html"

# Results (out/) are a user's, and stay.
clean:
	rm -rf .venv .venv-oldest build install log *.egg-info .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
