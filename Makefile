# Needs only Python 3.11 or newer; everything else goes into .venv. PYTHON=... chooses another Python.
PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11 python; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && { echo $$p; break; }; done)
BIN := .venv/bin
PYTEST = PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -rs -n auto --dist loadfile --no-loadscope-reorder
NO_NETWORK = echo "make: the packages that sealfit needs could not be installed; pip says why above." >&2
CODE := $(wildcard sealfit tests benchmarks docs/generate.py)

.DEFAULT_GOAL := help
.PHONY: help demo test test-long golden torture torture-rivals lint audit check docs bench bench-null bench-effects bench-coverage bench-loop bench-loop-cost bench-start bench-speed bench-worlds paper clean

help: ## list these targets
	@sed -n 's/^\([a-z][a-z-]*\):.*## \(.*\)/  make \1\t\2/p' $(MAKEFILE_LIST)

demo: .venv/.installed ## analyse the simulated campaign in sample_data, and say where the report is
	@$(BIN)/sealfit run sample_data/simulated --out demo-out

test: lint ## lint and run the tests
	$(PYTEST)

test-long: .venv/.installed-test ## counts over many simulated campaigns, and large campaigns: what make test leaves out
	$(PYTEST) -m long

golden: .venv/.installed-test ## compare ten campaigns with what is on record; after every step that is to move no number (three minutes)
	$(BIN)/python -m pytest -rs -n auto -m golden tests/golden

torture: .venv/.installed-test ## hostile input, faults of the system and long load; figures in benchmarks/RELIABILITY.md (half an hour)
	$(BIN)/python benchmarks/torture/pollution.py
	$(BIN)/python benchmarks/torture/fuzzing.py
	$(BIN)/python benchmarks/torture/faults.py
	$(BIN)/python benchmarks/torture/concurrency.py
	$(BIN)/python benchmarks/torture/digits.py --campaigns short no_load
	$(BIN)/python benchmarks/torture/digits.py --campaigns aged --changes force_1e+06 slots_mN_m_ms
	$(BIN)/python benchmarks/torture/load.py

torture-rivals: .venv/.installed-bench
	.venv/bench/bin/python benchmarks/torture/pollution.py --rivals

lint: .venv/.installed-test ## check style and formatting
	$(BIN)/ruff check $(CODE)
	$(BIN)/ruff format --check $(CODE)

docs: .venv/.installed-test ## build the documentation into out/docs
	$(BIN)/python docs/generate.py
	$(BIN)/zensical build --strict
	@echo out/docs/index.html

audit: .venv/.installed-audit ## compare the installed packages with the known vulnerabilities (pip-audit; needs a network)
	@.venv/audit/bin/pip-audit --strict --skip-editable --progress-spinner off --path .venv/lib/python*/site-packages || \
		{ echo "make: packages with known vulnerabilities, or the list of them could not be read; pip-audit says which." >&2; exit 1; }

check: test ## what the continuous integration runs: the same as test

bench: bench-null bench-effects bench-coverage bench-start ## long counts of false alarms, effects found and coverage (about half an hour)

bench-null: .venv/.installed-test
	$(BIN)/python benchmarks/false_alarms.py --seeds 3

bench-effects: .venv/.installed-test
	$(BIN)/python benchmarks/false_alarms.py --seeds 1 --strength strong --effects

bench-coverage: .venv/.installed-test
	$(BIN)/python benchmarks/coverage.py --campaigns 100

# In an environment of its own, as pygam holds scipy back. What is in out/loop.jsonl already is not run again.
bench-loop: .venv/.installed-bench ## close the loop on some 700 campaigns beside what people would use instead (90 minutes)
	.venv/bench/bin/python benchmarks/loop.py --out out/loop.jsonl

# Seeded by the newest commit. What out/worlds.jsonl holds is not run again; pass more with WORLDS="--size any --jobs 2".
bench-worlds: .venv/.installed-test ## sealfit on 600 campaigns drawn at random by another simulator (two hours and more)
	$(BIN)/python benchmarks/worlds.py --out out/worlds.jsonl --count 600 $(WORLDS)

# Side by side with a bare loop of pyarrow and with typer alone, so on a quiet machine.
bench-start: .venv/.installed-test
	$(BIN)/python benchmarks/speed.py startup ingest --work out/speed

bench-speed: .venv/.installed-test ## seconds and memory beside a bare read and a pandas script; up to 100,000 files (quiet machine)
	$(BIN)/python benchmarks/speed.py startup ingest memory run growth cluster --work out/speed

bench-loop-cost: .venv/.installed-test
	$(BIN)/python benchmarks/loop_cost.py

paper: .venv/.installed-test ## simulate and analyse the source paper's campaign, and write docs/paper
	$(BIN)/python benchmarks/paper.py

clean: ## remove everything that make made, .venv too
	rm -rf .venv demo-out build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
	find sealfit tests -name __pycache__ -type d -prune -exec rm -rf {} +

.venv/.installed: pyproject.toml
	@test -n "$(PYTHON)" || { echo "make: sealfit needs Python 3.11 or newer, and here is $$(python3 --version 2>&1 || echo no python3)." \
		"Install one, or name it: make PYTHON=/path/to/python3.11 demo" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "make: this Python cannot make virtual environments." \
		"On Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "installing sealfit into .venv ..." >&2
	@$(BIN)/python -m pip install -q --disable-pip-version-check -e . || { $(NO_NETWORK); exit 1; }
	@touch $@

.venv/.installed-test: .venv/.installed
	@$(BIN)/python -m pip install -q --disable-pip-version-check -e '.[test]' || { $(NO_NETWORK); exit 1; }
	@touch $@

.venv/.installed-bench: .venv/.installed
	@test -x .venv/bench/bin/python || $(BIN)/python -m venv .venv/bench
	@.venv/bench/bin/python -m pip install -q --disable-pip-version-check -e '.[bench]' || { $(NO_NETWORK); exit 1; }
	@touch $@

.venv/.installed-audit: .venv/.installed
	@test -x .venv/audit/bin/python || $(BIN)/python -m venv .venv/audit
	@.venv/audit/bin/python -m pip install -q --disable-pip-version-check pip-audit || { $(NO_NETWORK); exit 1; }
	@touch $@
