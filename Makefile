# make demo    depth, a new view and a report, of the example or of LEFT=… RIGHT=… (needs Python 3.11 or newer)
# make test    the tests
# make check   style, types, floors of imports, and the tests
# make fuzz    damaged files and requests for SECONDS=60, each answered by our own errors or kept in tests/corpus
# make bench   accuracy and time on the real pairs in STEREOWEAVE_TESTDATA
# make gallery the README's pictures, docs/gallery, from a pair that is rendered for them
# Each first sets up the virtual environment that it needs, once.

PYTHON ?= python3
STEREOWEAVE_TESTDATA ?= ../shared
# Of make fuzz; without a SEED each run draws one.
SECONDS ?= 60

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

RENDER = $(DEV)/bin/stereoweave synth make refinery --pairs 1 --seed 4000 --layout paper
RENDERED = $(foreach side,left right,runs/gallery/$(1)/$(side)/refinery/000000.png)
VIEW = $(DEV)/bin/stereoweave view

.PHONY: demo test check fuzz bench gallery

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

fuzz: $(DEV)/installed
	$(DEV)/bin/python -m fuzz --seconds $(SECONDS) $(if $(SEED),--seed $(SEED))

bench: $(CORE)/installed
	$(CORE)/bin/stereoweave bench pairs $(STEREOWEAVE_TESTDATA)/stereo/pairs \
		--model base --model small --model best --classes results/classes.csv --out results/pairs.csv

# The wiggle's frames are smaller, because it is as large as all other pictures together else.
gallery: $(DEV)/installed
	$(RENDER) --size 640x480 -o runs/gallery/pair
	$(RENDER) --size 400x300 -o runs/gallery/smaller
	$(DEV)/bin/stereoweave depth $(call RENDERED,pair) --model base -o runs/gallery/depth
	mkdir -p docs/gallery
	cp runs/gallery/depth/preview.png docs/gallery/depth.png
	$(VIEW) $(call RENDERED,pair) --layout side_by_side -o docs/gallery/pair.jpg
	$(VIEW) $(call RENDERED,pair) --position -0.5 -o docs/gallery/beyond_left.jpg
	$(VIEW) $(call RENDERED,pair) --position 0.5 -o docs/gallery/between.jpg
	$(VIEW) $(call RENDERED,pair) --position 1.5 -o docs/gallery/beyond_right.jpg
	$(VIEW) $(call RENDERED,pair) --layout anaglyph_dubois -o docs/gallery/anaglyph.jpg
	$(VIEW) $(call RENDERED,smaller) --layout wiggle -o docs/gallery/wiggle.webp

$(CORE)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(CORE)
	$(CORE)/bin/python -m pip install --constraint constraints.txt --editable .
	touch $@

$(DEV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(DEV)
	$(DEV)/bin/python -m pip install --constraint constraints.txt --editable '.[synth,train,video,app,cluster,dev]'
	touch $@
