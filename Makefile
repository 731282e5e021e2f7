# make demo    depth, a new view and a report, of the example or of LEFT=… RIGHT=… (needs Python 3.11 or newer)
# make test    the tests
# make check   style, types, floors of imports, and the tests
# make bench   accuracy and time on the real pairs in STEREOWEAVE_TESTDATA
# Each first sets up the virtual environment that it needs, once.

PYTHON ?= python3
STEREOWEAVE_TESTDATA ?= ../shared

# What users install: no PyTorch.
CORE = .venv-core
DEV = .venv

EXAMPLE = examples/left.png examples/right.png
ifeq ($(LEFT),)
ifneq ($(RIGHT),)
$(error RIGHT needs LEFT beside it: make demo LEFT=left.png RIGHT=right.png)
endif
PAIR = $(EXAMPLE)
CALIBRATION = --calib examples/calib.txt
else
PAIR = "$(LEFT)" $(if $(RIGHT),"$(RIGHT)")
endif

.PHONY: demo test check bench

demo: $(CORE)/installed
	$(CORE)/bin/stereoweave depth $(PAIR) $(CALIBRATION) --out demo-out
	$(CORE)/bin/stereoweave view $(PAIR) --position 0.5 --out demo-out/view.png
	@echo "Open the report in a browser: $(CURDIR)/demo-out/report.html"

test: $(DEV)/installed
	$(DEV)/bin/pytest

check: $(DEV)/installed
	$(DEV)/bin/ruff check
	$(DEV)/bin/ruff format --check
	$(DEV)/bin/mypy
	$(DEV)/bin/lint-imports
	$(DEV)/bin/pytest

bench: $(CORE)/installed
	$(CORE)/bin/stereoweave bench pairs $(STEREOWEAVE_TESTDATA)/stereo/pairs --out results/pairs.csv

$(CORE)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(CORE)
	$(CORE)/bin/python -m pip install --constraint constraints.txt --editable .
	touch $@

$(DEV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(DEV)
	$(DEV)/bin/python -m pip install --constraint constraints.txt --editable '.[synth,train,video,dev]'
	touch $@
