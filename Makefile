# make install   .venv with the `lipac` command
# make demo      build the demo scene, cull it, render it full and culled: out/demo
# make results   docs/results.md: cost against error of every policy on every scene (some hours)
# make accuracy  docs/accuracy.md: every hard case, measured (minutes)
# make animation docs/animation.md: animated scenes, measured (half an hour; single parts: lipac bench --only PART)
# make test      ruff, mypy, every test
# make extension one zip per platform, to install in Blender: dist
# PYTHON=/path/to/python picks the interpreter (default: a Python 3.13, else 3.11), VENV=folder the environment.

VENV ?= .venv
BIN := $(VENV)/bin
.PHONY: install demo results accuracy animation test smoke check clean
.DELETE_ON_ERROR:

install: $(VENV)/.installed
demo: install
	$(BIN)/python -m lipac.scripts.make_demo -o out/demo
results: install
	$(BIN)/python -m lipac.scripts.hybrid_results -o docs/results
	$(BIN)/python -m lipac.scripts.hybrid_pop -o docs/results
	$(BIN)/lipac evaluate --all -o docs/results --samples 64 --budget-check 20 --ray-budget
accuracy: $(VENV)/.installed-test
	$(BIN)/python -m lipac.scripts.accuracy
animation: install
	$(BIN)/lipac bench -o out/bench --only animation
	cp -r out/bench/animation.md out/bench/animation docs
extension: install
	$(BIN)/python -m pip install --disable-pip-version-check -q -e '.[extension]'
	$(BIN)/python -m lipac.scripts.make_extension
# Tests run even where lint or types complain, so that one look shows everything; any of the three fails the target.
test: $(VENV)/.installed-test
	@status=0; $(MAKE) check VENV=$(VENV) || status=$$?; $(BIN)/python -m pytest || status=$$?; exit $$status
smoke: $(VENV)/.installed-test
	$(BIN)/lipac --help > /dev/null
	$(BIN)/python -m pytest -m smoke

check: $(VENV)/.installed-test
	$(BIN)/ruff check .
	MYPYPATH=$(VENV)/src $(BIN)/mypy -p lipac

# A changed pyproject.toml installs anew.
$(VENV)/.installed: pyproject.toml | $(VENV)/src/lipac
	$(BIN)/python -m pip install --disable-pip-version-check -q -e .
	touch $@
$(VENV)/.installed-test: $(VENV)/.installed
	$(BIN)/python -m pip install --disable-pip-version-check -q -e '.[test]'
	touch $@

$(BIN)/python:
	python="$(PYTHON)"; [ -n "$$python" ] || python=$$(sh scripts/find_python.sh 3.13 3.11) && "$$python" -m venv $(VENV)
# The checkout under the package's name, for type checking (an editable install is invisible to mypy).
$(VENV)/src/lipac: | $(BIN)/python
	mkdir -p $(@D) && ln -sfn "$(CURDIR)" $@
clean:
	rm -rf .venv .venv311 out
