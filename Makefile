# make demo      depth, a new view and a report of a sample pair, or of LEFT=… RIGHT=… (needs Python 3.11 or newer)
# make test      run the tests, JOBS=3 files at a time
# make coverage  run the tests, and report which lines of the package they do not run
# make check     check style, types and imports between rooms, and run the tests
# make mutate    count how many of COUNT=400 changes of the sources, drawn by SEED, the tests notice; resumes
# make fuzz      read damaged files and requests for SECONDS=60; findings are kept in tests/corpus
# make bench     measure accuracy and time on the real pairs in STEREOWEAVE_TESTDATA
# make audit     check the licences of everything installed, and known vulnerabilities if the service answers
# make release   build the wheel and the source distribution in dist, list their dependencies (SBOM), and try both
# make gallery   render the pictures of the README and docs/views.md
# Each target creates the virtual environment that it needs, once.

PYTHON ?= python3
STEREOWEAVE_TESTDATA ?= ../shared
SECONDS ?= 60
COUNT ?= 400
JOBS ?= 3

# What users install: no PyTorch.
CORE = .venv-core
DEV = .venv
AUDIT = .venv-audit

# Containers often set it. Every process would then compile the package's sources, and tests start hundreds.
unexport PYTHONDONTWRITEBYTECODE

EXAMPLE = examples/left.png examples/right.png
PAIR = "$(LEFT)" $(if $(RIGHT),"$(RIGHT)")
ifeq ($(LEFT),)
ifneq ($(RIGHT),)
$(error RIGHT needs LEFT beside it: make demo LEFT=left.png RIGHT=right.png)
endif
endif

SBOM = $(AUDIT)/bin/cyclonedx-py environment --pyproject pyproject.toml --output-reproducible
VERSION = $(shell sed -n 's/^__version__ = "\(.*\)"/\1/p' stereoweave/__init__.py)
RENDER = $(DEV)/bin/stereoweave synth make refinery --pairs 1 --seed 4000 --layout paper
RENDERED = $(foreach side,left right,runs/gallery/$(1)/$(side)/refinery/000000.png)
VIEW = $(DEV)/bin/stereoweave view
# Three files at a time on two cores, because the system tests mostly wait for other programs.
PYTEST = $(DEV)/bin/pytest --numprocesses $(JOBS) --dist loadfile --no-loadscope-reorder

.PHONY: demo test coverage check fuzz mutate bench audit release gallery

demo: $(CORE)/installed
ifeq ($(LEFT),)
	$(CORE)/bin/stereoweave demo --out demo-out
else
	$(CORE)/bin/stereoweave depth $(PAIR) --out demo-out
	$(CORE)/bin/stereoweave view $(PAIR) --position 0.5 --out demo-out/view.png
	@echo "Open the report in a browser: $(CURDIR)/demo-out/report.html"
endif

test: $(DEV)/installed
	$(PYTEST)

# A target of its own: under the C tracer of Python 3.11 the tests of matching and io take a third more processor time.
coverage: $(DEV)/installed
	$(PYTEST) --cov

check: $(DEV)/installed
	$(DEV)/bin/ruff check
	$(DEV)/bin/ruff format --check
	$(DEV)/bin/mypy
	$(DEV)/bin/lint-imports
	@$(MAKE) --no-print-directory test

mutate: $(DEV)/installed
	$(DEV)/bin/python -m mutate --count $(COUNT) $(if $(SEED),--seed $(SEED))

fuzz: $(DEV)/installed
	$(DEV)/bin/python -m fuzz --seconds $(SECONDS) $(if $(SEED),--seed $(SEED))

bench: $(CORE)/installed
	$(CORE)/bin/stereoweave bench pairs $(STEREOWEAVE_TESTDATA)/stereo/pairs \
		--model base --model small --model best --classes results/classes.csv --out results/pairs.csv

# Without a +cpu at its end, because advisories are of versions that have none.
audit: $(DEV)/installed $(AUDIT)/installed
	$(AUDIT)/bin/pip-licenses --python $(DEV)/bin/python --summary
	@$(DEV)/bin/python -m pip freeze --exclude-editable | sed 's/+.*//' > $(AUDIT)/packages.txt
	@cd $(AUDIT) && if bin/pip-audit --requirement packages.txt --no-deps --disable-pip \
		--vulnerability-service osv --progress-spinner off > found.txt 2> log.txt; \
	then tail -n 1 log.txt; \
	elif grep '^Found' log.txt; then cat found.txt; exit 1; \
	else echo "Known vulnerabilities: not looked up, no answer from the service ($$(tail -n 1 log.txt))"; fi

# The wheel is built from the source distribution, which so has all that this needs. Files that an earlier build left
# would get into both.
release: $(CORE)/installed $(DEV)/installed $(AUDIT)/installed
	rm -rf build stereoweave.egg-info dist/stereoweave-$(VERSION)*
	$(AUDIT)/bin/python -m build --outdir dist .
	$(SBOM) --output-file dist/stereoweave-$(VERSION).cdx.json $(CORE)
	$(SBOM) --output-file dist/stereoweave-$(VERSION)-all-extras.cdx.json $(DEV)
	$(AUDIT)/bin/python -m release.check dist/stereoweave-$(VERSION)-py3-none-any.whl dist/stereoweave-$(VERSION).tar.gz

# The wiggle gets smaller frames: at full size it would be as large as all other pictures together.
gallery: $(DEV)/installed
	$(RENDER) --size 640x480 -o runs/gallery/pair
	$(RENDER) --size 400x300 -o runs/gallery/smaller
	$(DEV)/bin/stereoweave depth $(call RENDERED,pair) -o runs/gallery/depth
	mkdir -p docs/gallery
	cp runs/gallery/depth/preview.png docs/gallery/depth.png
	$(VIEW) $(call RENDERED,pair) --layout side_by_side -o docs/gallery/pair.jpg
	$(VIEW) $(call RENDERED,pair) --position -0.5 -o docs/gallery/beyond_left.jpg
	$(VIEW) $(call RENDERED,pair) --position 0.5 -o docs/gallery/between.jpg
	$(VIEW) $(call RENDERED,pair) --position 1.5 -o docs/gallery/beyond_right.jpg
	$(VIEW) $(call RENDERED,pair) --layout anaglyph_dubois -o docs/gallery/anaglyph.jpg
	$(VIEW) $(call RENDERED,smaller) --layout wiggle -o docs/gallery/wiggle.webp
	$(DEV)/bin/stereoweave depth $(EXAMPLE) --model best -o runs/gallery/ship_depth
	cp runs/gallery/ship_depth/preview.png docs/gallery/ship_depth.png
	$(VIEW) $(EXAMPLE) --position 0.5 -o docs/gallery/ship_between.jpg

$(CORE)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(CORE)
	$(CORE)/bin/python -m pip install --constraint constraints.txt --editable .
	touch $@

# Compiled after pip, on all cores: pip compiles on one. Files for other versions of Python, which some packages have, fail.
$(DEV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(DEV)
	$(DEV)/bin/python -m pip install --no-compile --constraint constraints.txt --editable '.[synth,train,video,heic,raw,app,cluster,mutate,dev]'
	$(DEV)/bin/python -m compileall -qq --workers 0 $(DEV)/lib || true
	touch $@

$(AUDIT)/installed: constraints.txt
	$(PYTHON) -m venv $(AUDIT)
	$(AUDIT)/bin/python -m pip install --constraint constraints.txt build cyclonedx-bom pip-audit pip-licenses
	touch $@
