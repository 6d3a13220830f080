# Targets of this project's own development, which the Makefile includes. `make help TARGET=all` lists them, too.
# Of each target the variables that it knows; make checks the names.
variables_fuzz := SECONDS SEED
variables_test := TIER PART COSTS
variables_test-all := PART
variables_bench := ROBOT
variables_wheel := OUT
variables_bench-runtime := SECONDS ROUNDS
$(foreach each,kernel clock others,$(eval variables_test-$(each) := $$(variables_test)))
# These targets have a fixed fleet, so FLEET and INVENTORY are errors.
with_own_fleet += check test test-all

##@ Development
.PHONY: check lint docs reference test test-all coverage bench runtime check-runtime fuzz bench-runtime requirements wheel
# One resolution of all groups, which keeps what is locked, then the part of each: no two have different versions.
of_build = pyproject.toml --group setup
of_station = $(of_build) --extra station
of_tests = $(of_station) --group tests
locked = $(PYTHON) images/pip_settings.py $(VENV)/bin/uv pip compile --universal --python-version 3.11 --generate-hashes \
    --no-emit-index-url --no-header --no-annotate --quiet
requirements: | setup ## lock the Python packages that pyproject.toml names again
	$(Q)cat requirements/build.lock requirements/station.lock requirements/tests.lock >$(BUILD)/requirements.lock
	$(Q)$(locked) $(of_tests) -o $(BUILD)/requirements.lock
	$(Q)set -e; $(foreach each,build station tests,\
	    $(locked) -c $(BUILD)/requirements.lock $(of_$(each)) -o requirements/$(each).lock;)
	$(Q)$(subst --universal,--python-platform x86_64-manylinux_2_28,$(locked)) --group ros -o requirements/ros.lock
	$(Q)$(locked) --group fuzz -o requirements/fuzz.lock

# A package of the tool for computers without this checkout, and the versions of its dependencies that were tested.
dist = $(if $(value OUT),$(call given,OUT),$(BUILD)/dist)
wheel: | setup ## build the Python package of this tool in build/dist | [OUT=dir]
	$(Q)mkdir -p $(dist); rm -f $(dist)/flotilla-*
	$(Q)$(step) "package" $(PYTHON) -m hatchling build -d $(dist)
	$(Q)sed -n 's/^\([A-Za-z0-9_.-]*==[^\\]*[^ \\]\).*/\1/p' requirements/station.lock >$(dist)/constraints.txt
	$(Q)cd $(dist) && sha256sum flotilla-* constraints.txt >SHA256SUMS && cat SHA256SUMS

check: | setup-tests lint check-runtime ## run lint, type checks and unit tests, without images
	$(Q)$(VENV)/bin/pytest -q tests/unit

docs: | $(VENV)/.tests ## build the documentation site in build/docs
	$(Q)$(step) "documentation" $(VENV)/bin/sphinx-build -q -E -W --keep-going -d $(BUILD)/docs/.doctrees docs $(BUILD)/docs

reference: | setup-station runtime ## write the generated pages of docs/reference
	$(Q)$(PYTHON) -m flotilla.reference

lint: | setup-tests docs
	$(Q)$(step) "Python's format" $(VENV)/bin/ruff format --check .
	$(Q)$(step) "Python's rules" $(VENV)/bin/ruff check .
	$(Q)$(step) "types" $(VENV)/bin/mypy
	$(Q)$(step) "types of Ansible's plug-ins" $(VENV)/bin/mypy ansible/library ansible/plugins rootfs_overlay/usr/lib/flotilla/update.py
	$(Q)$(step) "imports" $(VENV)/bin/lint-imports
	$(Q)$(step) "shell scripts" shellcheck $$($(call shell_scripts))
	$(Q)$(step) "playbooks" env -C ansible PATH="$(abspath $(VENV))/bin:$$PATH" ansible-lint --offline -q .

# Three at a time: tests that keep step with a clock come first, and need next to nothing; all else is nice to them. With
# all tests the own kernel comes too, which some of these wait for: without make's job server, which ninja cannot use.
COSTS = $(abspath $(BUILD))/reports/costs
TIERS := unit runtime image boot nightly
lanes_unit = test-others
lanes_runtime = test-clock test-others
lanes_image = test-others
lanes_boot = test-others
lanes_nightly = $(test_kernel) test-others
lanes_all = $(test_kernel) test-clock test-others
lanes_ = test-clock test-others
# A part compiles it where one of its tests asks for it.
test_kernel = $(if $(value PART),,test-kernel)
test: | setup-tests ## run the tests of CI: checks, images, guests in QEMU | [TIER=unit|runtime|image|boot|nightly]
	$(if $(filter-out $(TIERS) all,$(TIER)),$(error TIER=$(TIER): take one of $(TIERS)))
	$(if $(filter all nightly,$(TIER)),$(Q)images/install-host-packages tests/all-packages.txt)
	$(Q)mkdir -p $(dir $(COSTS)); rm -f $(COSTS)
	$(Q)MAKEFLAGS= TIER=$(TIER) COSTS=$(COSTS) $(PYTHON) -m tests.costs run "in all" \
	    $(MAKE) --no-print-directory -k -j3 $(lanes_$(TIER)); status=$$?; \
	    $(PYTHON) -m tests.costs show $(COSTS); exit $$status

test-all: | setup-tests ## run every test (hours), or one of several equal parts | [PART=3/8]
	$(Q)$(MAKE) test TIER=all

.PHONY: test-kernel test-clock test-others
run_tests = $(VENV)/bin/pytest tests --durations=20 --durations-min=10
accounted = $(PYTHON) -m tests.costs run
cost = nice -n 10 $(accounted)
selected_all = (nightly or not nightly)
selected = $(or $(selected_$(TIER)),$(TIER),not nightly)
test-kernel: | setup-tests
	$(Q)nice -n 5 $(accounted) kernel $(FLOTILLA) kernel

test-clock: | setup-tests
	$(Q)MAKEFLAGS= $(MAKE) --no-print-directory runtime
	$(Q)$(run_tests) -m '$(selected) and clock' >$(COSTS).clock 2>&1; status=$$?; cat $(COSTS).clock; exit $$status

# The first part of `make test-all` also runs the checks that are not tests.
checked = $(if $(TIER:all=),,$(if $(value PART),$(filter 1/%,$(value PART)),yes))
test-others: | setup-tests
ifneq ($(checked),)
	$(Q)MAKEFLAGS= $(cost) lint $(MAKE) --no-print-directory lint
	$(Q)MAKEFLAGS= $(cost) check-runtime $(MAKE) --no-print-directory check-runtime
	@# With a seed, so that a run without changes finds nothing new.
	$(if $(TIER),$(Q)MAKEFLAGS= $(cost) fuzz $(MAKE) --no-print-directory fuzz SECONDS=3 SEED=1)
endif
	$(if $(filter unit runtime,$(TIER)),,$(Q)$(cost) images $(FLOTILLA) image --all)
	$(Q)nice -n 10 $(run_tests) -m '$(selected) and not clock' -n 3

# In a directory of outputs of its own, whose runtime counts; cache, pool and environment are the usual ones.
covered = $(abspath $(BUILD))/coverage
# GCC 12 crashes when it checks formats in code that counts branches; every other build checks them.
uncounted_warnings = -Dc_args='-Wno-format-overflow -Wno-format-truncation'
coverage_report = $(abspath $(BUILD))/reports/coverage
coverage: export COVERAGE_FILE = $(covered)/.coverage
coverage: | setup-tests ## report branch coverage of the unit and runtime tests
	$(Q)mkdir -p $(covered) $(coverage_report)/c; ln -sfn ../cache ../pool ../venv $(covered)
	$(Q)find $(covered) -name '*.gcda' -delete; rm -f $(COVERAGE_FILE)*
	$(Q)set -e; $(call configured,$(covered)/runtime,,-Dtests=true -Db_coverage=true -Dbuildtype=debug $(uncounted_warnings))
	$(Q)$(call compile,$(covered)/runtime)
	@# What was taken is said of a red run, too.
	$(Q)$(meson) test -C $(covered)/runtime --no-rebuild --print-errorlogs --quiet; echo $$? >$(covered)/status
	$(Q)BUILD=$(covered) $(VENV)/bin/coverage run -m pytest -q tests -m 'unit or runtime'; echo $$? >>$(covered)/status
	@# A process that a test killed may leave half a file: it is named once, and counts for nothing.
	$(Q)$(VENV)/bin/coverage combine --quiet && rm -f $(COVERAGE_FILE).*
	$(Q)$(VENV)/bin/coverage html --quiet -d $(coverage_report)/python
	$(Q)$(VENV)/bin/coverage report --sort=miss >$(coverage_report)/python.txt; tail -1 $(coverage_report)/python.txt
	$(Q)$(VENV)/bin/gcovr --root runtime --exclude runtime/tests --txt-metric branch --txt $(coverage_report)/c.txt \
	    --html-nested $(coverage_report)/c/index.html --print-summary $(covered)/runtime
	$(Q)! grep -v -x 0 $(covered)/status

bench: | setup-tests ## measure build times, also of other image builders | [ROBOT=3]
	$(Q)$(PYTHON) -m evidence.bench $(if $(value ROBOT),$(call given,ROBOT))

meson = PATH="$(abspath $(VENV))/bin:$$PATH" meson
# A directory of meson's names the place of its sources: in a checkout that was moved it is made anew.
configured = { test -f $1/build.ninja && test "$$(cat $1/.place 2>&1)" = "$$(pwd -P)"; } || \
    { rm -rf $1; $2 $(meson) setup $1 runtime $3 >/dev/null; pwd -P >$1/.place; }
# The output of a compiler matters only if it fails.
compile = $(meson) compile -C $1 $2 >$1/compile.log || { cat $1/compile.log >&2; exit 1; }
runtime: | setup-runtime ## compile the runtime for this computer in build/runtime
	@# One after the other: processes that run tests ask for it at once.
	$(Q)mkdir -p $(BUILD); flock $(BUILD)/.runtime.lock sh -e -c $(call quoted,$(call \
	    configured,$(BUILD)/runtime); $(call compile,$(BUILD)/runtime))

check-runtime: | setup-runtime $(VENV)/.tests ## check the C code: format, clang-tidy, sanitized tests
	$(Q)$(step) "format of C" $(VENV)/bin/clang-format --dry-run -Werror $$(git ls-files '*.[ch]')
	$(Q)set -e; $(call configured,$(BUILD)/runtime-sanitized,,-Dtests=true \
	    -Db_sanitize=address$(comma)undefined -Dbuildtype=debugoptimized)
	$(Q)$(step) "compilation with sanitizers" env $(meson) compile -C $(BUILD)/runtime-sanitized
	$(Q)$(step) "clang-tidy" $(PYTHON) -m runtime.tidy $(BUILD)/runtime-sanitized
	$(Q)$(step) "unit tests of C" env $(meson) test -C $(BUILD)/runtime-sanitized --no-rebuild --print-errorlogs --quiet

fuzzed = -max_total_time=$(if $(value SECONDS),$(call given,SECONDS),60) $(if $(value SEED),-seed=$(call given,SEED)) \
    -timeout=10 -verbosity=0
fuzz: | setup-runtime setup-tests ## fuzz the parsers of robots and station with libFuzzer | [SECONDS=60] [SEED=1]
	$(Q)images/install-host-packages tests/fuzz-packages.txt
	$(Q)set -e; $(call configured,$(BUILD)/fuzz,CC=clang,-Dtests=true -Dfuzz=true -Dbuildtype=debugoptimized)
	$(Q)$(call compile,$(BUILD)/fuzz,fuzzers)
	$(Q)$(meson) test -C $(BUILD)/fuzz --suite fuzz --no-rebuild --print-errorlogs --quiet
	$(Q)$(PYTHON) images/pip_settings.py $(VENV)/bin/uv pip install --quiet --python $(PYTHON) --require-hashes --no-deps \
	    --target $(BUILD)/atheris -r requirements/fuzz.lock
	$(Q)set -e; for known in runtime/tests/fuzz/corpus/* tests/fuzz/corpus/*; do \
	    name=$${known##*/}; found=$(abspath $(BUILD))/found/$$name; \
	    case $$known in runtime/*) run=$(BUILD)/fuzz/tests/fuzz/fuzz_$$name; most=1024;; \
	        *) run="$(PYTHON) -m tests.fuzz $$name"; most=4096;; esac; \
	    mkdir -p $$found; echo "$$name:" $(if $(value SECONDS),$(call given,SECONDS),60) s; \
	    PYTHONPATH=$(BUILD)/atheris $$run $(fuzzed) -max_len=$$most \
	        -artifact_prefix=$$found- $$found $$known 2>$$found.log || { cat $$found.log >&2; exit 1; }; done

bench-runtime: | setup-runtime runtime ## measure blocks' processor time, also of LinuxCNC's HAL | [SECONDS=2] [ROUNDS=5]
	$(Q)images/install-host-packages runtime/bench/packages.txt
	$(Q)$(PYTHON) -m runtime.bench.bench $(BUILD)/runtime/flotilla-run $(call option,--seconds,SECONDS) \
	    $(call option,--rounds,ROUNDS)

comma := ,
given = $(call quoted,$(value $1))
option = $(if $(value $2),$1 $(call given,$2))
shell_scripts = git grep -l -E '^\#!/bin/(ba)?sh' -- flotilla images rootfs_overlay tests .ci
