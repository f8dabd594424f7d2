# Two commands on a bare machine: `make demo` and `make test`. Needs Python 3.11+ with venv, and nothing else.

PYTHON ?= python3
BIN := .venv/bin
EXTRAS := viewer,video,identify,train,sb3,export,rsl-rl,gpu,bench,docs,dev

.PHONY: help venv demo test quick arm lint types docs gallery links wheel clean

help:
	@echo "make demo    train Mini Cheetah to walk, then write a rollout to look at in a browser (a few minutes)"
	@echo "make test    run the tests"
	@echo "make quick   run the tests that take a few seconds each: some minutes"
	@echo "make arm     on a PC with Debian: some tests, and results bit by bit, on emulated 64-bit Arm (hours)"
	@echo "make lint    ruff: style and format"
	@echo "make types   pyright: types, as on Linux, macOS and Windows"
	@echo "make docs    this documentation as HTML in docs/_build/html; a warning is an error"
	@echo "make gallery make the pictures of robots in the documentation anew, moving ones from the policies that come along"
	@echo "make links   follow the links of README and docs that lead out into the web"
	@echo "make wheel   build sdist and wheel into dist/"
	@echo "make venv    create .venv with everything the others need"
	@echo "make clean   remove .venv and build output"

# The stamp makes a second run skip installation until the metadata changes.
.venv/installed: pyproject.toml constraints.txt
	@test -x $(BIN)/python || $(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(v < (3, 11) and \
		"make: $(PYTHON) is Python %d.%d; expected 3.11 or newer: make venv PYTHON=python3.11" % v[:2])'
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[$(EXTRAS)]"
	@touch .venv/installed

venv: .venv/installed

demo: .venv/installed
	@$(BIN)/python train/demo.py

test: .venv/installed
	$(BIN)/python -m pytest -n auto --dist loadfile

quick: .venv/installed
	$(BIN)/python -m pytest -n auto --dist loadfile -m "not slow and not stress"

arm: .venv/installed
	tests/arm.sh

lint: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# Types differ between systems only where a file uses modules of the operating system.
SYSTEM = asyncio|ctypes|errno|mmap|multiprocessing|os|pathlib|select|shutil|signal|socket|subprocess|sys|tempfile|threading|time
ON_SYSTEMS = $(shell grep -lrE '^ *(import|from) ($(SYSTEM))\b' --include='*.py' ce_gym train)

types: .venv/installed
	printf '%s\n' Linux 'Darwin $(ON_SYSTEMS)' 'Windows $(ON_SYSTEMS)' | xargs -P 3 -L 1 $(BIN)/pyright --pythonplatform

docs: .venv/installed
	$(BIN)/python -m sphinx -W --keep-going --nitpicky -q -b html docs docs/_build/html
	@echo docs/_build/html/index.html

gallery: .venv/installed
	$(BIN)/python docs/robots_picture.py
	for robot in cassie g1 jvrc1 mini_cheetah mit_humanoid spot t1 tello; do $(BIN)/python -m ce_gym play $${robot}_velocity --size 320 240 \
		--command 1.5 0.5 0 0 --command 1.5 0.5 0 0.8 --video docs/images/$${robot}.gif || exit 1; done
	$(BIN)/python -m ce_gym play mini_cheetah_stairs --seed 26 --command 7 0.6 0 0 --size 256 192 \
		--env-arg 'terrain={"kind": "stairs", "rise": 0.1, "curriculum": false}' --video docs/images/mini_cheetah_stairs.gif

links: .venv/installed
	$(BIN)/python -m sphinx -q -b linkcheck docs docs/_build/links

wheel: .venv/installed
	$(BIN)/python -m build --outdir dist

clean:
	rm -rf .venv build dist docs/_build docs/generated
