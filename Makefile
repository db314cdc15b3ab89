# Everything a newcomer runs. Needs only git, make and Python 3.11 or newer.
PYTHON ?= python3
UV := .bootstrap/bin/uv
VENV := .venv/bin
# What is installed has the versions and hashes of requirements.lock, or is refused.
LOCKED := --quiet --require-hashes --constraint requirements.lock --build-constraints requirements.lock

# A worker for each core, so one thread for each matrix library: several, with more threads than
# cores between them, mostly wait for each other. And one worker more, for a fifth of their time is waiting.
WORKERS = $$(($$(getconf _NPROCESSORS_ONLN) + 1))
PYTEST = OMP_NUM_THREADS=1 $(VENV)/pytest --numprocesses=$(WORKERS) --maxprocesses=8 --dist=worksteal $(PYTEST_ARGS)

# Bytecode is kept: without it, every process that a test starts compiles all that it imports.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo install extras client docs test test-all lint types javascript javascript-package audit sbom platforms wheels lowest image release workflows lock clean

demo: .venv/core
	$(VENV)/veilface demo

# The program alone, into .venv: what the real path needs, and a host.
install: .venv/core

# What the service does without and some commands need: `make extras EXTRAS=evaluate,audit`.
EXTRAS ?= all
extras: .venv/core
	$(UV) pip install --quiet --python $(VENV)/python --constraint requirements.lock -e ".[$(EXTRAS)]"

# The Python client, into .venv: what examples/login/login.py needs.
client: .venv/core
	$(UV) pip install --quiet --python $(VENV)/python --constraint requirements.lock -e clients/python

# What guards behaviour, in minutes.
test: .venv/dev
	$(PYTEST) -m "not long"

# And what takes long: real data in bulk, kills and outages, fuzzing, a browser.
test-all: test
	$(PYTEST) -m long

lint: .venv/dev
	$(VENV)/ruff check .
	$(VENV)/ruff format --check .

types: .venv/dev
	$(VENV)/mypy

# The client for browsers and Node, by Node's own tools: needs Node 20 or newer, and npm. The types of its answers come from
# the service's OpenAPI document. What the page runs of it is put into api/web/client.
javascript: .venv/core
	$(VENV)/python -c 'import json; from api.http.app import create_app; from api.settings import Settings; \
		print(json.dumps(create_app(Settings()).openapi()))' > clients/javascript/openapi.json
	cd clients/javascript && npm ci --no-audit --no-fund && npm run build && npm run page && npm test

# The package as a registry would get it, in dist/npm: installed alone, both of its exports load.
javascript-package: javascript
	rm -rf dist/npm && mkdir -p dist/npm/alone
	cd clients/javascript && npm pack --silent --pack-destination ../../dist/npm
	cd dist/npm/alone && echo '{"private": true, "type": "module"}' > package.json \
		&& npm install --no-audit --no-fund --silent --ignore-scripts --omit=peer ../veilface-client-*.tgz \
		&& node --input-type=module -e 'import { PrivateClient } from "veilface-client"; import { defineLogin } from "veilface-client/login";' \
		&& test -f node_modules/veilface-client/dist/index.d.ts \
		&& test -f node_modules/veilface-client/dist/element/login.d.ts
	rm -rf dist/npm/alone

# What the image depends on, and the wheel's core with it: known vulnerabilities, and a bill of materials (CycloneDX), which
# names what private mode runs too. Without an advisory service nothing is audited, which fails with status 3 of the script,
# and is said.
audit: dist/requirements.lock
	rm -f dist/audit.json
	-$(UV) tool run --quiet --from pip-audit==2.10.1 pip-audit --requirement dist/requirements.lock \
		--disable-pip --progress-spinner off --format json --output dist/audit.json >/dev/null 2>&1
	$(PYTHON) .ci/audit_report.py dist/audit.json

sbom: dist/requirements.lock
	$(UV) tool run --quiet --from cyclonedx-bom==7.5.0 cyclonedx-py requirements dist/requirements.lock \
		--output-reproducible --output-file dist/sbom.json
	$(PYTHON) .ci/sbom_of_page.py dist/sbom.json

# A wheel of every package that the image depends on, for both of its processors and each Python: nothing is compiled.
platforms: dist/requirements.lock
	for python in 3.11 3.12 3.13 3.14; do for processor in x86_64 aarch64; do \
		$(UV) pip compile --quiet --no-deps --only-binary :all: --python-version $$python \
		--python-platform $$processor-unknown-linux-gnu dist/requirements.lock >/dev/null || exit 1; done; done

# The site of docs/, in dist/docs; a link that leads nowhere fails.
docs: | $(UV)
	$(UV) tool run --quiet --from zensical==0.0.73 zensical build --strict

# The wheels of both distributions, with what private mode runs where `make javascript` built it; that of the client must do
# alone, in an environment of its own.
wheels: | $(UV)
	rm -rf dist/wheels .bootstrap/alone
	for folder in . clients/python; do $(UV) build --quiet --wheel --out-dir dist/wheels \
		--build-constraints requirements.lock --require-hashes $$folder || exit 1; done
	! $(PYTHON) -m zipfile -l dist/wheels/veilface-*.whl | grep -vE '^(File Name|veilface/|veilface-[^/]*\.dist-info/)'
	test ! -d api/web/client || $(PYTHON) -m zipfile -l dist/wheels/veilface-*.whl | grep -F api/web/client/client.js.gz >/dev/null
	$(UV) venv --quiet --python '>=3.11' .bootstrap/alone
	$(UV) pip install --quiet --python .bootstrap/alone/bin/python --constraint requirements.lock dist/wheels/veilface_client-*.whl
	.bootstrap/alone/bin/python -I -W error -c "import veilface_client, sys; sys.exit('api' in sys.modules)"

# The wheel with the oldest libraries that pyproject.toml allows, where a folder `api` would be imported instead of ours.
lowest: wheels
	rm -rf .bootstrap/lowest && mkdir -p .bootstrap/lowest/elsewhere/api
	echo 'raise SystemExit("the wrong api")' > .bootstrap/lowest/elsewhere/api/__init__.py
	$(UV) venv --quiet --python '>=3.11' .bootstrap/lowest/venv
	$(UV) pip install --quiet --python .bootstrap/lowest/venv/bin/python --resolution lowest-direct --only-binary :all: -r pyproject.toml
	$(UV) pip install --quiet --python .bootstrap/lowest/venv/bin/python --no-deps dist/wheels/veilface-*.whl
	cd .bootstrap/lowest/elsewhere && PYTHONPATH=. ../venv/bin/veilface demo

# The container's image, without a registry; as root.
image:
	.ci/image

# What is published of the version in pyproject.toml, in dist/release; refused before anything is built. Its image needs
# root and podman: IMAGE=no leaves it out.
IMAGE ?= yes
release:
	rm -rf dist/release && mkdir -p dist
	$(PYTHON) .ci/release_notes.py > dist/NOTES.md
	@test "$(IMAGE)" = no || { test "$$(id -u)" = 0 && command -v podman >/dev/null; } \
		|| { echo "no release: its image needs root and podman; IMAGE=no leaves it out" >&2; exit 1; }
	$(MAKE) javascript-package wheels sbom
	mkdir dist/release
	cp dist/NOTES.md dist/wheels/*.whl dist/npm/*.tgz dist/sbom.json dist/release
	test "$(IMAGE)" = no \
		|| .ci/image "dist/release/$$(basename dist/wheels/veilface-*.whl -py3-none-any.whl)-image.tar.gz"
	cd dist/release && sha256sum * > SHA256SUMS

# The workflows of a forge, without asking it.
workflows: | $(UV)
	$(UV) tool run --quiet --from zizmor==1.32.0 zizmor --quiet --offline --persona=pedantic --strict-collection .github/workflows

# What the image has of requirements.lock, for tools that know no other form: pip on a host, the audit, the bill of materials.
dist/requirements.lock: requirements.lock pyproject.toml | $(UV)
	mkdir -p dist
	$(UV) pip compile --quiet --universal --generate-hashes --python-version 3.11 --constraint requirements.lock pyproject.toml --extra postgres --extra redis -o $@

.venv/core: requirements.lock pyproject.toml | $(UV)
	test -x $(VENV)/python || $(UV) venv --quiet --python '>=3.11' .venv
	$(UV) pip install $(LOCKED) --python $(VENV)/python -r pyproject.toml
	$(UV) pip install --quiet --python $(VENV)/python --build-constraints requirements.lock --no-deps -e .
	touch $@

.venv/dev: clients/python/pyproject.toml .venv/core | $(UV)
	$(UV) pip install $(LOCKED) --python $(VENV)/python -r pyproject.toml --extra all --group dev
	$(UV) pip install --quiet --python $(VENV)/python --build-constraints requirements.lock --no-deps -e clients/python
	touch $@

# The version and hashes of uv stand in the lock file too.
.bootstrap/bin/uv: requirements.lock
	$(PYTHON) -m venv .bootstrap
	sed -n '/^uv==/,/[^\\]$$/p' requirements.lock > .bootstrap/uv.lock
	.bootstrap/bin/python -m pip install --quiet --require-hashes --requirement .bootstrap/uv.lock
	touch $@

lock: | $(UV)
	$(UV) pip compile --quiet --upgrade --universal --generate-hashes --python-version 3.11 pyproject.toml --extra all --group build --group dev -o requirements.lock

clean:
	rm -rf .venv .bootstrap dist clients/javascript/dist clients/javascript/node_modules api/web/client .schemathesis templates/distances/__pycache__ .mypy_cache .pytest_cache .ruff_cache .hypothesis
