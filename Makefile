# Every target calls setup first; it ends at once where there is nothing to do.
.PHONY: setup demo test test-core test-service thorough check lint ci bench validate clean

setup:
	@deploy/bootstrap.sh

demo: setup
	@.venv/bin/elps demo --out demo-out

# Kernels are compiled by one thread, so two files of tests at a time: 12 minutes for all in place of 17. What waits for
# leases and processes to end is left alone with its clocks.
test: test-core test-service

test-core: setup
	@.venv/bin/python -m pytest -n 2 --dist loadfile tests/core

test-service: setup
	@.venv/bin/python -m pytest --ignore tests/core

# What proves the same again as well (tests/core/tiers.py): 6 minutes more.
thorough: setup
	@.venv/bin/python -m pytest -n 2 --dist loadfile -m "" tests/core

# What most slips of the pen fall over: no rendering.
check: lint
	@.venv/bin/python -m pytest -n 2 tests/corpus tests/core/scene/test_hostile.py tests/core/scene/test_upgrade.py \
	    tests/core/scene/test_reading.py tests/core/estimate tests/core/test_settings.py tests/core/selection/test_race.py \
	    tests/worker/test_advance.py tests/worker/test_state.py

lint: setup
	@.venv/bin/ruff check
	@.venv/bin/ruff format --check
	@.venv/bin/mypy
	@.venv/bin/lint-imports

ci:
	@.ci/run

# All write their reports under docs/ and want a machine that does nothing else. The first job comes first: it compares
# what a user gets with Mitsuba itself, and takes four hours in three parts. Scenes that the project does not hold are
# taken from the folder SHARED. SCENE=FILE adds a comparison of the algorithms at equal time on that scene.
bench: setup
	@.venv/bin/python -m tests.benchmarks.first_job $(if $(SHARED),--shared $(SHARED))
	@.venv/bin/python -m tests.benchmarks.first_job --clock $(if $(SHARED),--shared $(SHARED))
	@.venv/bin/python -m tests.benchmarks.first_job --first-image $(if $(SHARED),--shared $(SHARED))
	@.venv/bin/python -m tests.benchmarks.main_job
	@.venv/bin/python -m tests.benchmarks.context
	@.venv/bin/python -m tests.benchmarks.enlightened
	@.venv/bin/python -m tests.benchmarks.algorithms $(if $(SCENE),--scene $(SCENE))

validate: setup
	@.venv/bin/python -m tests.benchmarks.validation

clean:
	rm -rf .venv demo-out build *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
