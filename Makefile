# make install   .venv with the `lipac` command
# make demo      build the demo scene, cull it, render it full and culled: out/demo
# make results   docs/results.md: cost against error of every policy on every scene (some hours)
# make accuracy  docs/accuracy.md: every hard case, measured (minutes)
# make animation docs/animation.md: animated scenes, measured (half an hour; single parts: lipac bench --only PART)
# make check     ruff, mypy, the quick tests, which need no Blender (two minutes)
# make test      ruff, mypy, every test, in two processes at a time (WORKERS=1: in one after the other)
# make blender   the tests of Blender's API and of Cycles' shading, on another Blender: make blender BLENDER=5.3
# make lock      newest versions that pyproject.toml allows into requirements*.txt, which all the others install
#                (UPGRADE= leaves what is there as it is: for a package more)
# make docs      pages that are written from the code, and the site: build/site
# make extension one zip per platform, to install in Blender: dist
# PYTHON=/path/to/python picks the interpreter (default: a Python 3.13, else 3.11), VENV=folder the environment.

VENV ?= .venv
BLENDER ?= 5.3
WORKERS ?= 2
UPGRADE ?= --upgrade
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
UV := uv==0.13.9
.PHONY: install demo results accuracy animation docs extension test smoke check lint blender lock clean
.DELETE_ON_ERROR:

install: $(VENV)/.installed
demo: install
	$(BIN)/python -m lipac.scripts.dev.make_demo -o out/demo
results: install
	$(BIN)/python -m lipac.scripts.studies.hybrid.results -o docs/results
	$(BIN)/python -m lipac.scripts.studies.hybrid.pop -o docs/results
	$(BIN)/lipac evaluate --all -o docs/results --samples 64 --budget-check 20 --ray-budget
accuracy: $(VENV)/.installed-test
	$(BIN)/python -m lipac.scripts.dev.accuracy
animation: install
	$(BIN)/lipac bench -o out/bench --only animation
	cp -r out/bench/animation.md out/bench/animation docs
docs: $(VENV)/.installed-test
	$(BIN)/python -m lipac.scripts.dev.pages
	$(BIN)/python -m mkdocs build --quiet
extension: $(VENV)/.installed-test
	$(BIN)/python -m lipac.scripts.dev.make_extension
# Each worker takes whole files, whose tests share what they build, and may use all processors.
# Tests run even where lint or types complain, so that one look shows everything; any of the three fails the target.
test: $(VENV)/.installed-test
	@status=0; $(MAKE) lint VENV=$(VENV) || status=$$?; $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder --durations=25 || status=$$?; exit $$status
check: lint
	$(BIN)/python -m pytest --durations=10 -m "not slow and not blender"
smoke: $(VENV)/.installed-test
	$(BIN)/lipac --help > /dev/null
	$(BIN)/python -m pytest -m smoke
lint: $(VENV)/.installed-test
	$(BIN)/ruff check .
	MYPYPATH=$(VENV)/src $(BIN)/mypy -p lipac

# Nothing but what the lock names is installed; setuptools too comes from it.
define install
	$(PIP) install -q --require-hashes --no-deps -r $(1)
	$(PIP) install -q --no-deps --no-build-isolation -e .
	touch $@
endef
$(VENV)/.installed: requirements.txt pyproject.toml | $(VENV)/src/lipac
	$(call install,requirements.txt)
$(VENV)/.installed-test: requirements-test.txt $(VENV)/.installed
	$(call install,requirements-test.txt)

# An environment of its own for another Blender: the lock, but for bpy.
blender: .venv-$(BLENDER)/.another-blender
	.venv-$(BLENDER)/bin/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder --durations=10 -m "blender and not slow or smoke"
.venv-%/.another-blender: requirements-test.txt pyproject.toml
	$(MAKE) .venv-$*/.installed-test VENV=.venv-$* PYTHON=$$(sh scripts/find_python.sh $(if $(filter 5.0,$*),3.11,3.13))
	.venv-$*/bin/python -m pip install -q --disable-pip-version-check --no-deps 'bpy==$*.*'
	touch $@

# One lock for every Python and platform. What only tests need is in the second; both agree on what they share.
lock: | $(BIN)/python
	$(BIN)/python -m venv $(VENV)-lock && $(VENV)-lock/bin/python -m pip install -q --disable-pip-version-check '$(UV)'
	$(call compile,requirements-test.txt,--extra test $(UPGRADE))
	$(call compile,requirements.txt,--constraint requirements-test.txt $(UPGRADE))
compile = echo setuptools | $(VENV)-lock/bin/uv --no-python-downloads pip compile pyproject.toml - -q --universal --python-version 3.11 \
	--generate-hashes --no-annotate --custom-compile-command 'make lock' $(2) -o $(1)

$(BIN)/python:
	python="$(PYTHON)"; [ -n "$$python" ] || python=$$(sh scripts/find_python.sh 3.13 3.11) && "$$python" -m venv $(VENV)
# The checkout under the package's name, for type checking (an editable install is invisible to mypy).
$(VENV)/src/lipac: | $(BIN)/python
	mkdir -p $(@D) && ln -sfn "$(CURDIR)" $@
clean:
	rm -rf .venv .venv-* out
