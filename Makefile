# Every target but `lock` and `clean` first makes .venv: once, with the versions and hashes of constraints.txt.

VENV := .venv
PY := $(VENV)/bin/python
READY := $(VENV)/.ready
PYTHON = $(shell for python in python3.11 python3; do \
	$$python -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 \
	&& echo $$python && break; done)

.DELETE_ON_ERROR:
.PHONY: demo test check bench gallery notebooks lock clean

demo: $(READY)  ## draw a glass ball, then recover its glass from a picture
	@mkdir -p out/demo
	$(PY) -m diffdisp render fixtures/scenes/bench_nbk7.toml -o out/demo/bench_nbk7.png --size 480x480 --samples 16
	$(PY) -m diffdisp fit fixtures/targets/ball_nbk7.toml fixtures/targets/ball_nbk7.npz -o out/demo/fit
	@echo
	@echo "The picture:           out/demo/bench_nbk7.png"
	@echo "The fit, as numbers:   out/demo/fit/fit.json"
	@echo "The fit, as a report:  out/demo/fit/report.png"

# Most of a test's time is compilation, which fills little more than one core.
test: $(READY)  ## every test, in as many processes as there are cores, eight at most
	@$(PY) -m pytest --numprocesses=auto --maxprocesses=8 --dist=worksteal --durations=15

check: $(READY)  ## format, lint, types
	@$(PY) -m ruff format --check .
	@$(PY) -m ruff check .
	@$(PY) -m mypy src

bench: $(READY)  ## every script of benchmarks/
	@for script in $(sort $(wildcard benchmarks/*.py)); do \
		echo "== $$script"; $(PY) $$script || exit 1; done

# Light that a ball of glass gathers is found by chance: the lamps take more samples than the others.
gallery: $(READY)  ## the pictures of docs/gallery.md
	@mkdir -p docs/gallery
	$(PY) -m diffdisp render fixtures/scenes/dispersion.toml -o docs/gallery/dispersion.png --size 640x480 --samples 512 --seed 0
	$(PY) -m diffdisp render fixtures/scenes/metal_and_matte.toml -o docs/gallery/metal_and_matte.png --size 640x480 --samples 1024 --seed 0
	$(PY) -m diffdisp render fixtures/scenes/lamps.toml -o docs/gallery/lamps.png --size 640x480 --samples 2048 --seed 0
	$(PY) -m diffdisp render fixtures/scenes/default.toml -o docs/gallery/default.png --size 640x480 --samples 512 --seed 0

notebooks: $(READY)  ## run every notebook; the executed copies go to out/notebooks/
	@mkdir -p out/notebooks
	@for notebook in $(sort $(wildcard notebooks/*.ipynb)); do \
		$(VENV)/bin/jupyter-execute --output=../out/notebooks/{notebook_name} $$notebook || exit 1; done

$(READY): constraints.txt pyproject.toml
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed, as python3.11 or python3." >&2; exit 1; }
	@echo "Setting up $(VENV) with $(PYTHON): once, a minute or two."
	@$(PYTHON) -m venv $(VENV)
	@$(PY) -m pip install -qq --require-hashes -r constraints.txt
	@$(PY) -m pip install -qq --no-deps --no-build-isolation -e .
	@touch $@

# Pins what pyproject.toml asks for. Pins that still fit are kept; `make lock UPGRADE=--upgrade` renews all.
# Index settings of the machine are left out, so that the hashes are those that PyPI publishes.
lock:
	@$(PYTHON) -m venv out/lock
	@out/lock/bin/python -m pip install -qq pip-tools
	@env -u PIP_FIND_LINKS -u PIP_INDEX_URL -u PIP_EXTRA_INDEX_URL PIP_CONFIG_FILE=/dev/null \
		out/lock/bin/pip-compile --quiet $(UPGRADE) --generate-hashes --extra test \
		--build-deps-for editable --strip-extras --no-header --no-emit-index-url \
		--no-emit-find-links --no-emit-trusted-host --output-file constraints.txt pyproject.toml

clean:
	rm -rf $(VENV) out build dist .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
