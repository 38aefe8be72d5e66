# Every target calls setup first; it ends at once where there is nothing to do.
.PHONY: setup demo test lint ci bench validate clean

setup:
	@deploy/bootstrap.sh

demo: setup
	@.venv/bin/elps demo --out demo-out

test: setup
	@.venv/bin/python -m pytest

lint: setup
	@.venv/bin/ruff check
	@.venv/bin/ruff format --check
	@.venv/bin/mypy
	@.venv/bin/lint-imports

ci:
	@.ci/run

# Both write their report under docs/ and want a machine that does nothing else.
bench: setup
	@.venv/bin/python -m tests.benchmarks.main_job

validate: setup
	@.venv/bin/python -m tests.benchmarks.validation

clean:
	rm -rf .venv demo-out build *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
