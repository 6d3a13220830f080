# All commands. `make help` lists the targets; V=1 shows the commands that they run.
# A fleet's home has outputs of its own; the Python environment is the checkout's.
VENV := $(or $(value BUILD),build)/venv
ifeq ($(value BUILD),)
BUILD := $(if $(value FLEET),$(value FLEET)/build,build)
endif
# Characters that no path in a command may contain; flotilla/common/paths.py has the same ones.
not_in_paths := ; & | < > ( ) ' " ` \ * ? [ ] { } ! $$ : % = \#
in_path = $(strip $(foreach each,$(not_in_paths),$(findstring $(each),$(value $1))) $(word 2,$(value $1)))
unfit = a path with blanks or with a character that means something to a shell;
$(if $(call in_path,CURDIR),$(error $(CURDIR): this checkout lies on $(unfit) move it))
$(foreach name,FLEET BUILD KEYS APPS INVENTORY,$(if $(call in_path,$(name)),$(error $(name)=$(value $(name)): is $(unfit) \
    take another directory)))
# With sudo, the files that make writes would belong to root; flotilla/common/sudo.py has the same message.
as_root := $(if $(filter-out 0,$(value SUDO_UID)),$(filter-out fleet-scale help,$(or $(MAKECMDGOALS),help)))
$(if $(as_root),$(if $(filter 0,$(shell id -u)),$(if $(filter 0,$(shell stat -c %u .)),,$(error make $(as_root) needs no root: \
    run it without sudo))))
export BUILD
# Names of files are UTF-8 in any user's locale: the virtual environment has the path of the checkout in its files.
export LC_ALL := C.UTF-8
PYTHON := $(VENV)/bin/python
FLOTILLA := $(PYTHON) -m flotilla
# Progress of a part of a command: a live line on a terminal, else a line at its end; its output if it fails.
step = $(PYTHON) -m flotilla.common.progress
Q := $(if $(filter-out 0,$(V)),,@)
export V FLEET MIRROR SECURITY_MIRROR SNAPSHOT KEYS APPS INVENTORY PART PYTHON3
# These targets have a fixed fleet, so FLEET and INVENTORY are errors.
$(foreach name,FLEET INVENTORY,$(if $(and $(value $(name)),$(filter wheeled wheeled-down scenarios check test test-all,\
    $(MAKECMDGOALS))),$(error $(name)=$(value $(name)): $(MAKECMDGOALS) has a fleet of its own; leave $(name) out)))
# Python imports no packages of the user's, and pip puts none among them.
unexport PYTHONHOME PYTHONPATH PIP_PREFIX PIP_TARGET PIP_USER
MAKEFLAGS += --no-print-directory
.DEFAULT_GOAL := help

##@ Cards
.PHONY: image images kernel flash boot ssh verify bundle verify-bundle size
image: | setup ## build the card image of one robot | ROBOT=3
	$(Q)$(FLOTILLA) image $(call need,ROBOT)

images: | setup ## build the card images of all robots
	$(Q)$(FLOTILLA) image --all

kernel: | setup ## compile the lean PREEMPT_RT kernel as a Debian package | [BOARD=smartcoret3]
	$(Q)$(FLOTILLA) kernel $(if $(value BOARD),$(call given,BOARD))

flash: | setup ## write a card and read it back | ROBOT=3 DEV=/dev/sdX|CARD=file [FORCE=word]
	$(Q)$(FLOTILLA) flash $(call need,ROBOT) $(or $(call option,--file,CARD),$(call need,DEV)) \
	    $(call option,--force,FORCE)

boot: | setup-lab ## boot a robot's image in QEMU on this terminal | ROBOT=3
	$(Q)$(FLOTILLA) boot $(call need,ROBOT)

ssh: | setup ## open a shell on a robot, or on its guest if one runs | ROBOT=3
	$(Q)$(FLOTILLA) ssh $(call need,ROBOT)

verify: | setup ## build an image a second time and compare every byte | ROBOT=3
	$(Q)$(FLOTILLA) verify $(call need,ROBOT)

bundle: | setup ## build the update bundle of a board | [BOARD=smartcoret3] [SIGNATURES="FILE ..."] [EXPIRES=2027-01-31]
	$(Q)$(FLOTILLA) bundle $(if $(value BOARD),$(call given,BOARD)) $(call option,--expires,EXPIRES) $(addprefix --signature=,$(call each_given,SIGNATURES))

verify-bundle: | setup ## rebuild a published bundle and compare it | BUNDLE=file
	$(Q)$(FLOTILLA) verify-bundle $(call need,BUNDLE)

size: | setup ## list the largest packages and files of an image | ROBOT=3
	$(Q)$(FLOTILLA) size $(call need,ROBOT)

##@ Fleet
.PHONY: fleet fleet-status fleet-down fleet-scale wheeled wheeled-down radio-capacity provision update releases station-join station-leave station-time
fleet: | setup-station setup-lab ## start a virtual fleet of QEMU guests in the background | N=4 [LINK=ibss]
	$(Q)$(FLOTILLA) fleet up $(call need,N) $(call option,--link,LINK)

fleet-status: | setup-station setup-lab ## list the guests of the virtual fleet and their state
	$(Q)$(FLOTILLA) fleet status

fleet-down: | setup-station setup-lab ## stop the virtual fleet
	$(Q)$(FLOTILLA) fleet down

wheeled: | setup-station setup-lab setup-runtime ## simulate wheeled robots to drive, until Ctrl-C | [N=1] [ROOM=corner]
	$(Q)$(FLOTILLA) wheeled $(call option,--room,ROOM) $(if $(value N),$(call given,N))

wheeled-down: | setup-station setup-lab setup-runtime ## stop the simulated wheeled robots
	$(Q)$(FLOTILLA) wheeled-down

fleet-scale: | setup-station setup-lab ## measure provisioning of N robots in containers (root) | N=32 [BOARD=smartcoret3]
	$(Q)$(FLOTILLA) fleet-scale $(call need,N) $(call option,--board,BOARD)

radio-capacity: | setup-station ## simulate how many robots one radio cell carries | [INVENTORY=dir] [STANDARD=b|b-short|g|g-mixed] [RATE=11M] [AREA=10] [PHASES=random] [UPDATE=1] [LIMIT=10] [MISSED=1] [COMPUTE=400] [SECONDS=60] [SEED=1]
	$(Q)$(FLOTILLA) radio-capacity $(call option,--inventory,INVENTORY) $(call option,--standard,STANDARD) $(call option,--rate,RATE) \
	    $(call option,--area,AREA) $(call option,--phases,PHASES) $(if $(filter-out 0,$(UPDATE)),--update) $(call option,--limit,LIMIT) \
	    $(call option,--missed,MISSED) $(call option,--compute,COMPUTE) $(call option,--seconds,SECONDS) $(call option,--seed,SEED)

update: | setup ## install the update bundle on the robots | [ROBOT=3] [ON=guests] [ARGS="-e stop_tasks=true"]
	$(Q)$(MAKE) provision PLAYBOOK=update

provision: | setup ## apply the inventory to the robots | [ROBOT=3] [PLAYBOOK=fleet|tasks|collect|reboot|replace] [ON=guests] [ARGS=--check]
	$(Q)$(FLOTILLA) provision $(call option,--robot,ROBOT) $(if $(filter guests,$(ON)),--guests) $(call option,--playbook,PLAYBOOK) \
	    $(if $(value ARGS),-- $(call each_given,ARGS))

releases: | setup ## list the release of each robot, and its trial state | [ROBOT=3] [JSON=1]
	$(Q)$(FLOTILLA) releases $(if $(value ROBOT),$(call given,ROBOT)) $(if $(filter-out 0,$(JSON)),--json)

station-join: | setup ## join the robots' ad hoc cell with this computer's radio | [ADAPTER=wlan0] [STATION=name]
	$(Q)$(FLOTILLA) station-join $(if $(value ADAPTER),$(call given,ADAPTER)) $(call option,--station,STATION)

station-leave: | setup ## leave the cell and restore the adapter's settings | [ADAPTER=wlan0]
	$(Q)$(FLOTILLA) station-leave $(if $(value ADAPTER),$(call given,ADAPTER))

station-time: | setup ## write the chrony files that make this computer the clock | [STATION=name]
	$(Q)$(FLOTILLA) station-time $(call option,--station,STATION)

##@ Apps
.PHONY: new-app import-model deploy
new-app: | setup ## create a working example app in apps/NAME | KIND=block|device|make|ert|fmu NAME=hover
	$(Q)$(FLOTILLA) new-app $(call need,KIND) $(call need,NAME)

import-model: | setup ## import MATLAB's packNGo archive as apps/NAME | ZIP=hover.zip NAME=hover [MODEL=name] [SAMPLE_TIMES=0.01,0.05]
	$(Q)$(FLOTILLA) import-model $(call need,ZIP) $(call need,NAME) $(call option,--model,MODEL) \
	    $(call option,--sample-times,SAMPLE_TIMES)

deploy: | setup ## build an app, copy it to a robot and start it | ROBOT=3 APP=dir [ON_ROBOT=1] [KEEP=1|RUN=start|stop|status|log|remove]
	$(Q)$(FLOTILLA) deploy $(call need,ROBOT) $(call need,APP) $(call option,--run,RUN) \
	    $(if $(filter-out 0,$(KEEP)),--keep) $(if $(filter-out 0,$(ON_ROBOT)),--on-robot)

##@ Inputs
.PHONY: init lock cve check-fleet requirements wheel
init: | setup ## make a directory for a fleet of your own | FLEET=dir
	$(Q)$(FLOTILLA) init $(call need,FLEET)

lock: | setup ## resolve package lists to exact versions and hashes | [ONLY=lock]
	$(Q)$(FLOTILLA) lock $(call option,--only,ONLY)

cve: | setup ## check the locks against Debian's security tracker | TRACKER=file|address [JSON=1]
	$(Q)$(FLOTILLA) cve $(call option,--tracker,TRACKER) $(if $(filter-out 0,$(JSON)),--json)

check-fleet: | setup ## validate the inventory
	$(Q)$(FLOTILLA) check-fleet

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
dist = $(BUILD)/dist
wheel: | setup ## build the Python package of this tool in build/dist
	$(Q)rm -rf $(dist)
	$(Q)$(step) "package" $(PYTHON) -m hatchling build -d $(abspath $(dist))
	$(Q)sed -n 's/^\([A-Za-z0-9_.-]*==[^\\]*[^ \\]\).*/\1/p' requirements/station.lock >$(dist)/constraints.txt
	$(Q)cd $(dist) && sha256sum * >SHA256SUMS && cat SHA256SUMS

##@ Keys
.PHONY: rotate-key revoke-key admit-operator revoke-operator operators backup-keys restore-keys
rotate-key: | setup ## replace the key of a robot or of the operator | ROBOT=3|KEY=operator, provision, then again with RETIRE=1 [FORCE=1]
	$(Q)$(FLOTILLA) rotate-key $(if $(value KEY),$(call given,KEY),$(call need,ROBOT)) $(if $(filter-out 0,$(RETIRE)),--retire) \
	    $(if $(filter-out 0,$(FORCE)),--force)

revoke-key: | setup ## revoke the host key of a stolen robot | ROBOT=3, then provision the other robots
	$(Q)$(FLOTILLA) revoke-key $(call need,ROBOT)

admit-operator: | setup ## issue a certificate that lets a person into all robots | NAME=alice KEY_FILE=alice.pub [DAYS=30] [FROM=addresses] [OUT=dir]
	$(Q)$(FLOTILLA) admit-operator $(call option,--days,DAYS) $(call option,--from,FROM) $(call option,--out,OUT) -- $(call need,NAME) $(call need,KEY_FILE)

revoke-operator: | setup ## revoke a person's certificates | NAME=alice, then provision
	$(Q)$(FLOTILLA) revoke-operator $(call need,NAME)

operators: | setup ## list the certificates: name, expiry, revocation
	$(Q)$(FLOTILLA) operators

backup-keys: | setup ## write all keys to one encrypted file | OUT=file [PASSWORD_FILE=file]
	$(Q)$(FLOTILLA) backup-keys $(call need,OUT) $(call option,--password-file,PASSWORD_FILE)

restore-keys: | setup ## restore all keys from an encrypted file | FILE=file [PASSWORD_FILE=file]
	$(Q)$(FLOTILLA) restore-keys $(call need,FILE) $(call option,--password-file,PASSWORD_FILE)

##@ Quality
.PHONY: check lint docs reference test test-all bench power-cuts
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

power-cuts: | setup-station setup-lab setup-runtime ## replay a power cut at every write of an update | [BOARD=smartcoret3] [MIB=16]
	$(Q)$(FLOTILLA) power-cuts $(call option,--board,BOARD) $(call option,--mib,MIB)

bench: | setup-tests ## measure build times, also of other image builders | [ROBOT=3]
	$(Q)$(PYTHON) -m evidence.bench $(if $(value ROBOT),$(call given,ROBOT))

##@ Runtime
.PHONY: runtime check-runtime fuzz bench-runtime param scope station record live top drive positions fetch convert report
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

station: | setup-station ## serve a page that shows, drives and tunes the fleet | [PORT=8080] [ADDRESS=127.0.0.1] [OUT=file] [REPLAY=file] [SECONDS=60]
	$(Q)$(FLOTILLA) station $(call option,--inventory,INVENTORY) $(call option,--port,PORT) $(call option,--page-address,ADDRESS) $(call option,--record,OUT) \
	    $(call option,--replay,REPLAY) $(call option,--seconds,SECONDS)

# Only one program can receive at a port, so variables give further tasks to the same program.
station = $(call option,--seconds,SECONDS) $(call option,--live-address,ADDRESS) $(call option,--inventory,INVENTORY)
record: | setup-station ## record telemetry to an MCAP file | [OUT=file] [SECONDS=60] [PORT=8765] [ADDRESS=127.0.0.1]
	$(Q)$(FLOTILLA) record $(station) $(call option,--live,PORT) $(call each_given,OUT)

live: | setup-station ## stream live telemetry to Foxglove | [PORT=8765] [ADDRESS=127.0.0.1] [ORIGIN=http://localhost:8080] [SECONDS=60] [OUT=file]
	$(Q)$(FLOTILLA) live $(station) $(call option,--record,OUT) $(call option,--origin,ORIGIN) $(call each_given,PORT)

top: | setup-station ## show a live telemetry table; start and stop tasks by key | [ASK=1] [SECONDS=60] [OUT=file] [PORT=8765] [ADDRESS=127.0.0.1]
	$(Q)$(FLOTILLA) top $(station) $(if $(filter-out 0,$(ASK)),--ask) $(call option,--record,OUT) $(call option,--live,PORT)

drive: | setup-station ## drive a wheeled robot by keyboard or gamepad | ROBOT=5 [INPUT=keyboard|gamepad|/dev/input/eventN]
	$(Q)$(FLOTILLA) drive $(call need,ROBOT) $(call option,--input,INPUT) $(call option,--inventory,INVENTORY)

positions: | setup-station ## forward indoor positions to a robot, authenticated | ROBOT=3 [PORT=5010] [INTERFACE=eth1] [STATION=name]
	$(Q)$(FLOTILLA) positions $(call need,ROBOT) $(call option,--port,PORT) $(call option,--interface,INTERFACE) \
	    $(call option,--station,STATION) $(call option,--inventory,INVENTORY)

fetch: | setup ## copy the recorder files of a robot's task | ROBOT=3 TASK=heading [OUT=dir]
	$(Q)$(FLOTILLA) fetch $(call need,ROBOT) $(call need,TASK) $(call option,--out,OUT)

convert: | setup-station ## convert recordings to MCAP, CSV or MAT | FILE="log-000001.rec log-000002.rec" OUT=run.mcap|run.csv|run.mat [TOPIC=/robot3/control/report]
	$(Q)$(FLOTILLA) convert $(call option,--topic,TOPIC) $(call need,OUT) $(call need_each,FILE)

report: | setup-station ## write a page of plots from recordings | FILE=run.mcap|"log-*.rec" [OUT=page.html]
	$(Q)$(FLOTILLA) report $(call option,--out,OUT) $(call need_each,FILE)

param: | setup ## list or set the parameters of a running task or app | ROBOT=1 TASK=heading [PARAM=attitude.kp [VALUE=2.5 [CONFIRM=old]]]
	$(Q)$(FLOTILLA) param $(call option,--confirm,CONFIRM) $(call need,ROBOT) $(call need,TASK) $(if $(value PARAM),$(call given,PARAM) $(call option,--,VALUE))

scope: | setup ## show or record the signals of a running task | ROBOT=1 TASK=heading [SIGNALS="gyro.rate"] [EVERY=5] [ROWS=20] [TRIGGER='gyro.rate>0.1'] [BEFORE=10] [CSV=file]
	$(Q)$(FLOTILLA) scope $(call need,ROBOT) $(call option,--every,EVERY) $(call option,--rows,ROWS) $(call option,--trigger,TRIGGER) \
	    $(call option,--before,BEFORE) $(call option,--csv,CSV) -- $(call need,TASK) $(call each_given,SIGNALS)

##@ Real time
.PHONY: latency latency-accept boot-time hwcheck accept scenarios scenarios-accept
# The system to measure: the board's with each kernel, or with one kernel, or a part of it, or a robot.
measured = $(call option,--board,BOARD) $(call option,--kernel,KERNEL) $(call option,--plan,PLAN)
latency: | setup-lab setup-runtime ## measure latency in virtual time; compare with a baseline | [PLAN=quick|standard|disk] [BOARD=x86_64] [KERNEL=lean|debian|no-rt] [TARGET=ssh:robot3]
	$(Q)$(FLOTILLA) latency $(measured) $(call option,--target,TARGET)

hwcheck: | setup ## write a robot's hardware to a file, or draft a board's file | ROBOT=3 [SECONDS=60] or TARGET=ssh:USER@HOST NAME=board
	$(Q)$(FLOTILLA) hwcheck $(if $(value TARGET),$(call option,--target,TARGET) $(call option,--name,NAME),$(call need,ROBOT)) \
	    $(call option,--seconds,SECONDS)

accept: | setup-station setup-lab setup-runtime ## test a robot's hardware and write a signed report | ROBOT=3 [PLAN=standard|quick|none] [SECONDS=60] [RELAYS=1] [WATCHDOG=1]
	$(Q)$(FLOTILLA) accept $(call need,ROBOT) $(call option,--plan,PLAN) $(call option,--seconds,SECONDS) $(if $(filter-out 0,$(RELAYS)),--relays) \
	    $(if $(filter-out 0,$(WATCHDOG)),--watchdog)

latency-accept: | setup-lab setup-runtime ## measure latency and store it as the new baseline | [BOARD=x86_64] [KERNEL=lean|debian] [PLAN=quick]
	$(Q)$(FLOTILLA) latency-accept $(measured)

boot-time: | setup-lab setup-runtime ## measure the steps of a boot in virtual time | [BOARD=x86_64] [KERNEL=lean|debian] [PLAN=quick]
	$(Q)$(FLOTILLA) boot-time $(measured)

scenarios: | setup-station setup-lab setup-runtime ## simulate robots with packet loss and link failures | [SIDE=0.03] [FLIGHTS="udp dds"|all] [BOARD=x86_64] [ON=guests|lockstep] [LINK=ibss] [ROBOTS=16]
	$(Q)$(FLOTILLA) scenarios $(addprefix --,$(filter guests lockstep,$(ON))) $(call option,--link,LINK) $(call option,--robots,ROBOTS) $(call option,--side,SIDE) $(call option,--board,BOARD) $(call each_given,FLIGHTS)

scenarios-accept: | setup-station setup-lab setup-runtime ## run the scenarios and store them as the new baseline
	$(Q)$(FLOTILLA) scenarios-accept

##@ Housekeeping
.PHONY: setup setup-station setup-lab setup-runtime setup-tests clean help
setup: $(VENV)/.build ## install what `make image` needs

# Git, or the program that unpacked an archive, may have ended lines with CR LF, which shells do not accept.
$(if $(shell grep -l "$$(printf '\r')" images/install-host-packages Makefile),$(error the files of this checkout end their \
    lines with CR LF; take a new clone of the repository, or unpack the archive without a conversion of texts))

# The Python environment has what the locks of its groups name: what a command does not need is not installed for it.
set_up = $(Q)images/set-up-python $(VENV) $(patsubst .%,%,$(@F))
.PHONY: unusable
# Of another Python, of another place, or of another checkout's packages.
unusable := $(if $(shell images/environment-state $(VENV)),unusable,\
    $(if $(filter $(shell pwd -P),$(file <$(VENV)/.installed)),,unusable))
$(VENV)/.build: requirements/build.lock images/host-packages.txt pyproject.toml $(unusable)
	$(set_up)

$(VENV)/.station: requirements/station.lock $(VENV)/.build
	$(set_up)

$(VENV)/.tests: requirements/tests.lock requirements/tests-source.lock $(VENV)/.station
	$(set_up)

setup-station: $(VENV)/.station ## install what a station needs: page, recordings, reports

# Each command installs what it needs: guests, the runtime for this computer, a browser for the tests of pages.
setup-lab: setup ## install what QEMU guests need
	$(Q)images/install-host-packages flotilla/lab/host-packages.txt

setup-runtime: setup ## install what compiling the runtime needs
	$(Q)images/install-host-packages runtime/host-packages.txt

setup-tests: $(VENV)/.tests ## install what the tests need
	$(Q)images/install-host-packages tests/host-packages.txt flotilla/lab/host-packages.txt runtime/host-packages.txt

clean: ## remove all outputs except keys
	$(Q)rm -rf $(BUILD)

help: ## show this list, or the variables of one target | [TARGET=flash]
	@awk -v target=$(call given,TARGET) -F ':.*## ' 'BEGIN {if (!target) print "The variables of one target: make help TARGET=flash"} \
	    /^##@ / && !target {printf "\n%s\n", substr($$0, 5)} /^##= / && !target {print "  " substr($$0, 5)} \
	    /^[a-z-]+:.*## / {split($$2, text, " [|] ")} \
	    /^[a-z-]+:.*## / && !target {printf "  %-17s%s\n", $$1, text[1]} \
	    /^[a-z-]+:.*## / && $$1 == target {printf "make %s %s\n    %s\n", $$1, text[2], text[1]; found = 1} \
	    END {if (target && !found) {print "TARGET=" target ": no such target; see make help" >"/dev/stderr"; exit 2}}' $(MAKEFILE_LIST)

##@ Variables of all targets
##= MIRROR=           Debian mirror; default: the one in this computer's apt files
##= SECURITY_MIRROR=  Debian mirror of security updates; default as above
##= SNAPSHOT=         snapshot archive, for locked packages that left the mirror
##= FLEET=            directory of your fleet; default: the example fleet
##= BUILD=            directory of outputs; default: build/
##= KEYS=             directory of keys; default: keys/ of FLEET, or ansible/keys/
##= APPS=             directory of apps; default: apps/
##= INVENTORY=        directory of the inventory; default: that of FLEET
##= ANY_HOST=1        also set up a computer that is not a supported host
##= PYTHON3=          Python interpreter; default: python3
##= V=1               show the commands

comma := ,
# Values of variables reach a program verbatim, as one word or as several: no shell interprets them.
quoted = '$(subst ','\'',$1)'
given = $(call quoted,$(value $1))
each_given = $(foreach each,$(value $1),$(call quoted,$(each)))
option = $(if $(value $2),$1 $(call given,$2))
need = $(if $(value $1),$(call given,$1),$(error say which: make $@ $1=…))
need_each = $(if $(call need,$1),$(call each_given,$1))
shell_scripts = git grep -l -E '^\#!/bin/(ba)?sh' -- flotilla images rootfs_overlay tests .ci
