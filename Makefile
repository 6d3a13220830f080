# Front door. `make help` lists the targets; V=1 shows the commands.
BUILD ?= build
# Paths that stand in commands as they are; flotilla/common/paths.py has the same characters.
not_in_paths := ; & | < > ( ) ' " ` \ * ? [ ] { } ! $$ : % = \#
in_path = $(strip $(foreach each,$(not_in_paths),$(findstring $(each),$(value $1))) $(word 2,$(value $1)))
unfit = a path with blanks or with a character that means something to a shell;
$(if $(call in_path,CURDIR),$(error $(CURDIR): this checkout lies on $(unfit) move it))
$(foreach name,BUILD KEYS APPS INVENTORY,$(if $(call in_path,$(name)),$(error $(name)=$(value $(name)): is $(unfit) \
    take another directory)))
export BUILD
# Names of files are UTF-8 in any user's locale: the virtual environment has the path of the checkout in its files.
export LC_ALL := C.UTF-8
VENV := $(BUILD)/venv
PYTHON := $(VENV)/bin/python
FLOTILLA := $(PYTHON) -m flotilla
# A part of a command: a line that moves on a terminal, a line at its end without one; what it says when it fails.
step = $(PYTHON) -m flotilla.common.progress
Q := $(if $(filter-out 0,$(V)),,@)
export V MIRROR SECURITY_MIRROR SNAPSHOT KEYS APPS INVENTORY PART PYTHON3
# Of these the fleet is fixed; nobody shall think that it was another.
$(if $(and $(value INVENTORY),$(filter wheeled wheeled-down scenarios check test test-all,$(MAKECMDGOALS))),$(error \
    INVENTORY=$(value INVENTORY): $(MAKECMDGOALS) has a fleet of its own; leave INVENTORY out))
# Python imports no packages of the user's, and pip puts none among them.
unexport PYTHONHOME PYTHONPATH PIP_PREFIX PIP_TARGET PIP_USER
MAKEFLAGS += --no-print-directory
.DEFAULT_GOAL := help

##@ Cards
.PHONY: image images kernel flash boot ssh verify bundle verify-bundle size
image: | setup ## card image of one robot: make image ROBOT=3
	$(Q)$(FLOTILLA) image $(call need,ROBOT)

images: | setup ## card images of the whole fleet
	$(Q)$(FLOTILLA) image --all

kernel: | setup ## our own real-time kernel as a Debian package: make kernel [BOARD=]
	$(Q)$(FLOTILLA) kernel $(if $(value BOARD),$(call given,BOARD))

flash: | setup ## write a card and read it back: make flash ROBOT=3 DEV=/dev/sdX (or CARD=file)
	$(Q)$(FLOTILLA) flash $(call need,ROBOT) $(or $(call option,--file,CARD),$(call need,DEV)) \
	    $(call option,--force,FORCE)

boot: | setup-lab ## boot a robot's image in QEMU on this terminal
	$(Q)$(FLOTILLA) boot $(call need,ROBOT)

ssh: | setup ## shell on a robot, or on its guest when one runs: make ssh ROBOT=3
	$(Q)$(FLOTILLA) ssh $(call need,ROBOT)

verify: | setup ## build a second time under other circumstances and compare to the byte
	$(Q)$(FLOTILLA) verify $(call need,ROBOT)

bundle: | setup ## the release of a board for robots in service: make bundle [BOARD=] [SIGNATURES="FILE ..."]
	$(Q)$(FLOTILLA) bundle $(if $(value BOARD),$(call given,BOARD)) $(addprefix --signature=,$(call each_given,SIGNATURES))

verify-bundle: | setup ## build what a published bundle holds, and compare: make verify-bundle BUNDLE=file
	$(Q)$(FLOTILLA) verify-bundle $(call need,BUNDLE)

size: | setup ## the largest packages and files of a robot's image
	$(Q)$(FLOTILLA) size $(call need,ROBOT)

##@ Fleet
.PHONY: fleet fleet-status fleet-down fleet-scale wheeled wheeled-down radio-capacity provision update releases station-join station-leave station-time
fleet: | setup-station setup-lab ## a virtual fleet of guests in the background, to try things on: make fleet N=4 [LINK=ibss]
	$(Q)$(FLOTILLA) fleet up $(call need,N) $(call option,--link,LINK)

fleet-status: | setup-station setup-lab ## what the guests of the virtual fleet do
	$(Q)$(FLOTILLA) fleet status

fleet-down: | setup-station setup-lab ## end the virtual fleet
	$(Q)$(FLOTILLA) fleet down

wheeled: | setup-station setup-lab setup-runtime ## wheeled robots in a room, to be driven from this computer, until Ctrl-C: make wheeled [N=1] [ROOM=corner]
	$(Q)$(FLOTILLA) wheeled $(call option,--room,ROOM) $(if $(value N),$(call given,N))

wheeled-down: | setup-station setup-lab setup-runtime ## end them
	$(Q)$(FLOTILLA) wheeled-down

fleet-scale: | setup-station setup-lab ## how provisioning grows with the fleet, on robots in containers, as root: make fleet-scale N=32 [BOARD=]
	$(Q)$(FLOTILLA) fleet-scale $(call need,N) $(call option,--board,BOARD)

radio-capacity: | setup-station ## how many robots one radio cell carries, simulated [INVENTORY=dir STANDARD=b|b-short|g|g-mixed RATE=11M AREA=10 PHASES=random UPDATE=1 LIMIT=10 MISSED=1 COMPUTE=400 SEED=1]
	$(Q)$(FLOTILLA) radio-capacity $(call option,--inventory,INVENTORY) $(call option,--standard,STANDARD) $(call option,--rate,RATE) \
	    $(call option,--area,AREA) $(call option,--phases,PHASES) $(if $(filter-out 0,$(UPDATE)),--update) $(call option,--limit,LIMIT) \
	    $(call option,--missed,MISSED) $(call option,--compute,COMPUTE) $(call option,--seconds,SECONDS) $(call option,--seed,SEED)

update: | setup ## robots take the bundle of their board: make update [ROBOT=3] [ON=guests] [ARGS="-e stop_tasks=true"]
	$(Q)$(MAKE) provision PLAYBOOK=update

provision: | setup ## robots become what the inventory says: make provision [ROBOT=3] [ON=guests] [ARGS=--check]
	$(Q)$(FLOTILLA) provision $(call option,--robot,ROBOT) $(if $(filter guests,$(ON)),--guests) $(call option,--playbook,PLAYBOOK) \
	    $(if $(value ARGS),-- $(call each_given,ARGS))

releases: | setup ## which release each robot runs, since when, on trial or confirmed: make releases [ROBOT=3] [JSON=1]
	$(Q)$(FLOTILLA) releases $(if $(value ROBOT),$(call given,ROBOT)) $(if $(filter-out 0,$(JSON)),--json)

station-join: | setup ## put this computer's 802.11 adapter into the robots' ad hoc cell: make station-join [ADAPTER=wlan0] [STATION=]
	$(Q)$(FLOTILLA) station-join $(if $(value ADAPTER),$(call given,ADAPTER)) $(call option,--station,STATION)

station-leave: | setup ## take it out of the cell, and put everything back: make station-leave [ADAPTER=wlan0]
	$(Q)$(FLOTILLA) station-leave $(if $(value ADAPTER),$(call given,ADAPTER))

station-time: | setup ## what this computer's chrony needs to lead the robots' time, in build/station-time [STATION=]
	$(Q)$(FLOTILLA) station-time $(call option,--station,STATION)

##@ Apps
.PHONY: new-app import-model deploy
new-app: | setup ## a working start of an app, in apps/NAME: make new-app KIND=block|ert|fmu|make NAME=hover
	$(Q)$(FLOTILLA) new-app $(call need,KIND) $(call need,NAME)

import-model: | setup ## MATLAB's packNGo archive becomes apps/NAME: ZIP=hover.zip NAME=hover [MODEL=] [SAMPLE_TIMES=0.01,0.05]
	$(Q)$(FLOTILLA) import-model $(call need,ZIP) $(call need,NAME) $(call option,--model,MODEL) \
	    $(call option,--sample-times,SAMPLE_TIMES)

deploy: | setup ## build, send and run an app: ROBOT=3 APP=dir [ON_ROBOT=1] [KEEP=1 | RUN=start|stop|status|log|remove]
	$(Q)$(FLOTILLA) deploy $(call need,ROBOT) $(call need,APP) $(call option,--run,RUN) \
	    $(if $(filter-out 0,$(KEEP)),--keep) $(if $(filter-out 0,$(ON_ROBOT)),--on-robot)

##@ Inputs
.PHONY: lock cve check-fleet requirements
lock: | setup ## resolve the package lists against the mirror: exact versions and hashes [ONLY=name of a lock]
	$(Q)$(FLOTILLA) lock $(call option,--only,ONLY)

cve: | setup ## known vulnerabilities of what the locks hold, by Debian's tracker: make cve TRACKER=FILE or address [JSON=1]
	$(Q)$(FLOTILLA) cve $(call option,--tracker,TRACKER) $(if $(filter-out 0,$(JSON)),--json)

check-fleet: | setup ## validate the fleet's description
	$(Q)$(FLOTILLA) check-fleet

# One resolution of all groups, which keeps what is locked, then the part of each: no two have different versions.
all_inputs = requirements/build.in requirements/station.in requirements/tests.in
locked = $(PYTHON) images/pip_settings.py $(VENV)/bin/uv pip compile --universal --python-version 3.11 --generate-hashes \
    --no-emit-index-url --no-header --no-annotate --quiet
requirements: | setup ## lock the groups of the Python environment anew: requirements/*.in
	$(Q)cat $(all_inputs:in=lock) >$(BUILD)/requirements.lock
	$(Q)$(locked) $(all_inputs) -o $(BUILD)/requirements.lock
	$(Q)set -e; for each in $(all_inputs:.in=); do \
	    $(locked) -c $(BUILD)/requirements.lock $$each.in -o $$each.lock; done

##@ Keys
.PHONY: rotate-key revoke-key admit-operator revoke-operator operators backup-keys restore-keys
rotate-key: | setup ## a new key for a robot or the operator: make rotate-key ROBOT=3 or KEY=operator, provision, then RETIRE=1 [FORCE=1]
	$(Q)$(FLOTILLA) rotate-key $(if $(value KEY),$(call given,KEY),$(call need,ROBOT)) $(if $(filter-out 0,$(RETIRE)),--retire) \
	    $(if $(filter-out 0,$(FORCE)),--force)

revoke-key: | setup ## refuse the host key of a robot that is in other hands: make revoke-key ROBOT=3, then provision the others
	$(Q)$(FLOTILLA) revoke-key $(call need,ROBOT)

admit-operator: | setup ## let a person into all robots for some days: make admit-operator NAME=alice KEY_FILE=alice.pub [DAYS=30] [FROM=addresses] [OUT=directory]
	$(Q)$(FLOTILLA) admit-operator $(call option,--days,DAYS) $(call option,--from,FROM) $(call option,--out,OUT) -- $(call need,NAME) $(call need,KEY_FILE)

revoke-operator: | setup ## refuse a person's certificates: make revoke-operator NAME=alice, then provision
	$(Q)$(FLOTILLA) revoke-operator $(call need,NAME)

operators: | setup ## who has a certificate, until when, expired or revoked
	$(Q)$(FLOTILLA) operators

backup-keys: | setup ## all keys in one encrypted file: make backup-keys OUT=FILE [PASSWORD_FILE=]
	$(Q)$(FLOTILLA) backup-keys $(call need,OUT) $(call option,--password-file,PASSWORD_FILE)

restore-keys: | setup ## put them back: make restore-keys FILE=FILE [PASSWORD_FILE=]
	$(Q)$(FLOTILLA) restore-keys $(call need,FILE) $(call option,--password-file,PASSWORD_FILE)

##@ Quality
.PHONY: check lint docs reference test test-all bench power-cuts
check: | setup-tests lint check-runtime ## lint, types and unit tests, of the runtime too; no images, no QEMU
	$(Q)$(VENV)/bin/pytest -q tests/unit

docs: | $(VENV)/.tests ## the documentation as a site, in build/docs/index.html; warnings are errors, nothing is fetched
	$(Q)$(step) "documentation" $(VENV)/bin/sphinx-build -q -E -W --keep-going -d $(BUILD)/docs/.doctrees docs $(BUILD)/docs

reference: | setup-station runtime ## write the pages of docs/reference that are made from the sources
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
test: | setup-tests ## checks, images, and a test of each area in QEMU: what CI runs; one tier alone: TIER=unit|runtime|image|boot|nightly
	$(if $(filter-out $(TIERS) all,$(TIER)),$(error TIER=$(TIER): take one of $(TIERS)))
	$(if $(filter all nightly,$(TIER)),$(Q)images/install-host-packages tests/all-packages.txt)
	$(Q)mkdir -p $(dir $(COSTS)); rm -f $(COSTS)
	$(Q)MAKEFLAGS= TIER=$(TIER) COSTS=$(COSTS) $(PYTHON) -m tests.costs run "in all" \
	    $(MAKE) --no-print-directory -k -j3 $(lanes_$(TIER)); status=$$?; \
	    $(PYTHON) -m tests.costs show $(COSTS); exit $$status

test-all: | setup-tests ## every test there is, hours; in parts of the same cost: make test-all [PART=3/8]
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

# What is no test belongs to the first part.
checked = $(if $(TIER:all=),,$(if $(value PART),$(filter 1/%,$(value PART)),yes))
test-others: | setup-tests
ifneq ($(checked),)
	$(Q)MAKEFLAGS= $(cost) lint $(MAKE) --no-print-directory lint
	$(Q)MAKEFLAGS= $(cost) check-runtime $(MAKE) --no-print-directory check-runtime
	@# With a seed, so that whoever changed nothing finds nothing.
	$(if $(TIER),$(Q)MAKEFLAGS= $(cost) fuzz $(MAKE) --no-print-directory fuzz SECONDS=3 SEED=1)
endif
	$(if $(filter unit runtime,$(TIER)),,$(Q)$(cost) images $(FLOTILLA) image --all)
	$(Q)nice -n 10 $(run_tests) -m '$(selected) and not clock' -n 3

# In a directory of outputs of its own, whose runtime counts; cache, pool and environment are the usual ones.
covered = $(abspath $(BUILD))/coverage
# GCC 12 crashes where it judges formats in code that counts branches; every other build judges them.
uncounted_warnings = -Dc_args='-Wno-format-overflow -Wno-format-truncation'
coverage_report = $(abspath $(BUILD))/reports/coverage
coverage: export COVERAGE_FILE = $(covered)/.coverage
coverage: | setup-tests ## branches of Python and C that unit and runtime tests take, in build/reports/coverage
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

power-cuts: | setup-station setup-lab setup-runtime ## every power cut of updates replayed: bricks, wrong releases, mistakes found [BOARD=] [MIB=16]
	$(Q)$(FLOTILLA) power-cuts $(call option,--board,BOARD) $(call option,--mib,MIB)

bench: | setup-tests ## wall times and ratios against other builders
	$(Q)$(FLOTILLA) bench $(if $(value ROBOT),$(call given,ROBOT))

##@ Runtime
.PHONY: runtime check-runtime fuzz bench-runtime param scope station record live top drive positions fetch convert report
meson = PATH="$(abspath $(VENV))/bin:$$PATH" meson
# A directory of meson's names the place of its sources: in a checkout that was moved it is made anew.
configured = { test -f $1/build.ninja && test "$$(cat $1/.place 2>&1)" = "$$(pwd -P)"; } || \
    { rm -rf $1; $2 $(meson) setup $1 runtime $3 >/dev/null; pwd -P >$1/.place; }
# What a compiler says matters when it fails.
compile = $(meson) compile -C $1 $2 >$1/compile.log || { cat $1/compile.log >&2; exit 1; }
runtime: | setup-runtime ## the runtime's programs for this computer, in build/runtime
	@# One after the other: processes that run tests ask for it at once.
	$(Q)mkdir -p $(BUILD); flock $(BUILD)/.runtime.lock sh -e -c $(call quoted,$(call \
	    configured,$(BUILD)/runtime); $(call compile,$(BUILD)/runtime))

check-runtime: | setup-runtime $(VENV)/.tests ## format of all C, the runtime's clang-tidy and unit tests with AddressSanitizer and UBSan
	$(Q)$(step) "format of C" $(VENV)/bin/clang-format --dry-run -Werror $$(git ls-files '*.[ch]')
	$(Q)set -e; $(call configured,$(BUILD)/runtime-sanitized,,-Dtests=true \
	    -Db_sanitize=address$(comma)undefined -Dbuildtype=debugoptimized)
	$(Q)$(step) "compilation with sanitizers" env $(meson) compile -C $(BUILD)/runtime-sanitized
	$(Q)$(step) "clang-tidy" $(PYTHON) -m runtime.tidy $(BUILD)/runtime-sanitized
	$(Q)$(step) "unit tests of C" env $(meson) test -C $(BUILD)/runtime-sanitized --no-rebuild --print-errorlogs --quiet

fuzz: | setup-runtime ## the runtime's parsers: a million streams each, then libFuzzer [SECONDS=60 SEED=]; finds go to build/found
	$(Q)images/install-host-packages tests/fuzz-packages.txt
	$(Q)set -e; $(call configured,$(BUILD)/fuzz,CC=clang,-Dtests=true -Dfuzz=true -Dbuildtype=debugoptimized)
	$(Q)$(call compile,$(BUILD)/fuzz,fuzzers)
	$(Q)$(meson) test -C $(BUILD)/fuzz --suite fuzz --no-rebuild --print-errorlogs --quiet
	$(Q)set -e; for known in runtime/tests/fuzz/corpus/*; do \
	    name=$${known##*/}; found=$(BUILD)/found/$$name; \
	    mkdir -p $$found; echo "$$name:" $(if $(value SECONDS),$(call given,SECONDS),60) s; \
	    $(BUILD)/fuzz/tests/fuzz/fuzz_$$name -max_total_time=$(if $(value SECONDS),$(call given,SECONDS),60) $(if $(value SEED),-seed=$(call given,SEED)) -max_len=1024 -timeout=10 -verbosity=0 \
	        -artifact_prefix=$$found- $$found $$known 2>$$found.log || { cat $$found.log >&2; exit 1; }; done

bench-runtime: | setup-runtime runtime ## what a block costs, beside LinuxCNC's HAL, in one run [SECONDS=2 ROUNDS=5]
	$(Q)images/install-host-packages runtime/bench/packages.txt
	$(Q)$(PYTHON) -m runtime.bench.bench $(BUILD)/runtime/flotilla-run $(call option,--seconds,SECONDS) \
	    $(call option,--rounds,ROUNDS)

station: | setup-station ## a page to see the fleet, drive, tune and record it [PORT=8080 ADDRESS=127.0.0.1 OUT=file INVENTORY=]; show a recording: REPLAY=file
	$(Q)$(FLOTILLA) station $(call option,--inventory,INVENTORY) $(call option,--port,PORT) $(call option,--page-address,ADDRESS) $(call option,--record,OUT) \
	    $(call option,--replay,REPLAY) $(call option,--seconds,SECONDS)

# One program receives, since a port can be received at only once: what it does with it is told by variables too.
station = $(call option,--seconds,SECONDS) $(call option,--live-address,ADDRESS) $(call option,--inventory,INVENTORY)
record: | setup-station ## record telemetry to an MCAP file, for Foxglove or PlotJuggler: make record [OUT=file] [SECONDS= INVENTORY=]
	$(Q)$(FLOTILLA) record $(station) $(call option,--live,PORT) $(call each_given,OUT)

live: | setup-station ## serve it to Foxglove while it comes [PORT=8765 ADDRESS=127.0.0.1]; record it too: OUT=file
	$(Q)$(FLOTILLA) live $(station) $(call option,--record,OUT) $(call each_given,PORT)

top: | setup-station ## how it comes: rate, link, age, flags; keys act on tasks [SECONDS=]; also how tasks run: ASK=1; OUT=, PORT= as above
	$(Q)$(FLOTILLA) top $(station) $(if $(filter-out 0,$(ASK)),--ask) $(call option,--record,OUT) $(call option,--live,PORT)

drive: | setup-station ## command a robot on wheels: make drive ROBOT=5 [INPUT=keyboard|gamepad|/dev/input/eventN] [INVENTORY=]
	$(Q)$(FLOTILLA) drive $(call need,ROBOT) $(call option,--input,INPUT) $(call option,--inventory,INVENTORY)

positions: | setup-station ## positions of the indoor positioning system to a robot, with proof: make positions ROBOT=3 [PORT=5010] [INTERFACE=eth1] [STATION=] [INVENTORY=]
	$(Q)$(FLOTILLA) positions $(call need,ROBOT) $(call option,--port,PORT) $(call option,--interface,INTERFACE) \
	    $(call option,--station,STATION) $(call option,--inventory,INVENTORY)

fetch: | setup ## recorder files of a robot's task: make fetch ROBOT=3 TASK=heading [OUT=directory]
	$(Q)$(FLOTILLA) fetch $(call need,ROBOT) $(call need,TASK) $(call option,--out,OUT)

convert: | setup-station ## make MCAP, CSV or MAT of recordings: make convert FILE="log-000001.rec log-000002.rec" OUT=run.mcap|run.csv|run.mat [TOPIC=/robot3/control/report]
	$(Q)$(FLOTILLA) convert $(call option,--topic,TOPIC) $(call need,OUT) $(call need_each,FILE)

report: | setup-station ## a page of recordings: paths, commands, hops, latency: make report FILE=run.mcap|"log-*.rec" [OUT=page.html]
	$(Q)$(FLOTILLA) report $(call option,--out,OUT) $(call need_each,FILE)

param: | setup ## parameters of a task or an app that runs: make param ROBOT=1 TASK=heading [PARAM=attitude.kp [VALUE=2.5 [CONFIRM=old]]]
	$(Q)$(FLOTILLA) param $(call option,--confirm,CONFIRM) $(call need,ROBOT) $(call need,TASK) $(if $(value PARAM),$(call given,PARAM) $(call option,--,VALUE))

scope: | setup ## signals of a task that runs: ROBOT=1 TASK=heading [SIGNALS="gyro.rate"] [EVERY= ROWS= TRIGGER='gyro.rate>0.1' BEFORE=] [CSV=file]
	$(Q)$(FLOTILLA) scope $(call need,ROBOT) $(call option,--every,EVERY) $(call option,--rows,ROWS) $(call option,--trigger,TRIGGER) \
	    $(call option,--before,BEFORE) $(call option,--csv,CSV) -- $(call need,TASK) $(call each_given,SIGNALS)

##@ Real time
.PHONY: latency latency-accept boot-time hwcheck accept scenarios scenarios-accept
# What is measured: the board's system with each kernel, or one of them, or less of it, or a robot.
measured = $(call option,--board,BOARD) $(call option,--kernel,KERNEL) $(call option,--plan,PLAN)
latency: | setup-lab setup-runtime ## latency in virtual time against the accepted run, or limits (an hour): PLAN=standard [BOARD= KERNEL=lean|debian|no-rt PLAN=disk]; or TARGET=ssh:robot3
	$(Q)$(FLOTILLA) latency $(measured) $(call option,--target,TARGET)

hwcheck: | setup ## a robot's hardware in one file, to send with a bug report: make hwcheck ROBOT=3
	$(Q)$(FLOTILLA) hwcheck $(call need,ROBOT) $(call option,--seconds,SECONDS)

accept: | setup-station setup-lab setup-runtime ## is a robot what its board's file asks: a signed report: make accept ROBOT=3 [PLAN=standard|quick|none SECONDS=60 RELAYS=1 WATCHDOG=1]
	$(Q)$(FLOTILLA) accept $(call need,ROBOT) $(call option,--plan,PLAN) $(call option,--seconds,SECONDS) $(if $(filter-out 0,$(RELAYS)),--relays) \
	    $(if $(filter-out 0,$(WATCHDOG)),--watchdog)

latency-accept: | setup-lab setup-runtime ## measure both kernels, or KERNEL=, and a control loop, and make that the accepted latency [BOARD=]
	$(Q)$(FLOTILLA) latency-accept $(measured)

boot-time: | setup-lab setup-runtime ## where a boot spends its time, in virtual time
	$(Q)$(FLOTILLA) boot-time $(measured)

scenarios: | setup-station setup-lab setup-runtime ## a robot flown by four computers, links that lose or are cut: a report [SIDE=0.03; published: 1] [FLIGHTS="udp dds" | all] [BOARD=] [ON=guests [LINK=ibss] | ON=lockstep | ROBOTS=16]
	$(Q)$(FLOTILLA) scenarios $(addprefix --,$(filter guests lockstep,$(ON))) $(call option,--link,LINK) $(call option,--robots,ROBOTS) $(call option,--side,SIDE) $(call option,--board,BOARD) $(call each_given,FLIGHTS)

scenarios-accept: | setup-station setup-lab setup-runtime ## make a new run the accepted one: commit lab/scenarios/baseline.json
	$(Q)$(FLOTILLA) scenarios-accept

##@ Housekeeping
.PHONY: setup setup-station setup-lab setup-runtime setup-tests clean help
setup: $(VENV)/.build ## install what building needs

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

setup-station: $(VENV)/.station ## install what a station needs: its page, recordings and reports

# Each command installs what it needs: guests, the runtime for this computer, a browser for the tests of pages.
setup-lab: setup ## install what guests need
	$(Q)images/install-host-packages tests/lab-packages.txt

setup-runtime: setup ## install what the runtime for this computer needs
	$(Q)images/install-host-packages tests/runtime-packages.txt

setup-tests: $(VENV)/.tests ## install what testing needs
	$(Q)images/install-host-packages tests/host-packages.txt tests/lab-packages.txt tests/runtime-packages.txt

clean: ## remove all outputs; keys stay
	$(Q)rm -rf $(BUILD)

help: ## this list
	@awk -F ':.*## ' '/^##@/ {printf "\n%s\n", substr($$0, 5)} /^[a-z-]+:.*## / {printf "  %-14s %s\n", $$1, $$2} \
	    /^##= / {print "  " substr($$0, 5)}' $(MAKEFILE_LIST)

##@ Variables of all targets
##= MIRROR=           Debian mirror; by default the one of this computer's apt, on other systems Debian's own
##= SECURITY_MIRROR=  the same for security updates
##= SNAPSHOT=         snapshot archive for locked packages that left the mirror
##= BUILD=            where outputs go instead of build/
##= KEYS=             where keys are instead of ansible/keys/
##= APPS=             where apps are instead of apps/
##= INVENTORY=        the fleet's description instead of ansible/inventory/; wheeled, scenarios and tests have their own
##= ANY_HOST=1        set up a computer that is none of the supported hosts
##= PYTHON3=          the Python that builds, instead of python3 of the path or of the system
##= V=1               show the commands

comma := ,
# What somebody gave reaches a program as it stands, as one word or as several: no shell reads it as a command.
quoted = '$(subst ','\'',$1)'
given = $(call quoted,$(value $1))
each_given = $(foreach each,$(value $1),$(call quoted,$(each)))
option = $(if $(value $2),$1 $(call given,$2))
need = $(if $(value $1),$(call given,$1),$(error say which: make $@ $1=…))
need_each = $(if $(call need,$1),$(call each_given,$1))
shell_scripts = git grep -l -E '^\#!/bin/(ba)?sh' -- flotilla images lab rootfs_overlay tests .ci
