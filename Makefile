# Everything a newcomer runs. Needs only git, make and Python 3.11 or newer.
PYTHON ?= python3
UV := $(or $(shell command -v uv),.bootstrap/bin/uv)
VENV := .venv/bin

.PHONY: demo test lint types lock clean

demo: .venv/core
	$(VENV)/veilface demo

test: .venv/dev
	$(VENV)/pytest $(PYTEST_ARGS)

lint: .venv/dev
	$(VENV)/ruff check .
	$(VENV)/ruff format --check .

types: .venv/dev
	$(VENV)/mypy

.venv/core: requirements.lock pyproject.toml | $(UV)
	test -x $(VENV)/python || $(UV) venv --quiet --python '>=3.11' .venv
	$(UV) pip install --quiet --python $(VENV)/python --require-hashes -r requirements.lock
	$(UV) pip install --quiet --python $(VENV)/python --no-deps -e .
	touch $@

.venv/dev: requirements-dev.lock .venv/core | $(UV)
	$(UV) pip install --quiet --python $(VENV)/python --require-hashes -r requirements-dev.lock
	touch $@

.bootstrap/bin/uv:
	$(PYTHON) -m venv .bootstrap
	.bootstrap/bin/python -m pip install --quiet uv

lock: | $(UV)
	$(UV) pip compile --quiet --upgrade pyproject.toml --universal --generate-hashes --python-version 3.11 -o requirements.lock
	$(UV) pip compile --quiet pyproject.toml --group dev --universal --generate-hashes --python-version 3.11 -c requirements.lock -o requirements-dev.lock

clean:
	rm -rf .venv .bootstrap templates/kernels/__pycache__ .mypy_cache .pytest_cache .ruff_cache .hypothesis
