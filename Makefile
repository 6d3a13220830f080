# Front door. `make help` lists the targets; V=1 shows the commands.
# `make deploy BUILD=remote` compiles on the robot, as ON_ROBOT=1 does; of everything else BUILD is the directory of outputs.
ifeq ($(BUILD) $(filter deploy,$(MAKECMDGOALS)),remote deploy)
override BUILD := build
ON_ROBOT := 1
endif
BUILD ?= build
# Paths that stand in commands as they are.
not_in_paths := ; & | < > ( ) ' " ` \ * ? [ ] { } ! $$
in_path = $(foreach each,$(not_in_paths),$(findstring $(each),$(value $1))) $(word 2,$(value $1))
$(foreach name,BUILD KEYS,$(if $(strip $(call in_path,$(name))),$(error $(name)=$(value $(name)): is a path with blanks \
    or with a character that means something to a shell; take another directory)))
export BUILD
VENV := $(BUILD)/venv
PYTHON := $(VENV)/bin/python
FLOTILLA := $(PYTHON) -m images.builder
Q := $(if $(filter-out 0,$(V)),,@)
export V MIRROR SECURITY_MIRROR SNAPSHOT KEYS
MAKEFLAGS += --no-print-directory
.DEFAULT_GOAL := help

##@ Cards
.PHONY: image images kernel flash boot ssh verify size
image: | setup ## card image of one robot: make image ROBOT=3
	$(Q)$(FLOTILLA) image --robot $(call need,ROBOT)

images: | setup ## card images of the whole fleet
	$(Q)$(FLOTILLA) image --all

kernel: | setup ## our own real-time kernel as a Debian package: make kernel BOARD=smartcoret3
	$(Q)$(FLOTILLA) kernel --board $(call need,BOARD)

flash: | setup ## write a card and read it back: make flash ROBOT=3 DEV=/dev/sdX (or CARD=file)
	$(Q)$(FLOTILLA) flash --robot $(call need,ROBOT) $(or $(call option,--file,CARD),--device $(call need,DEV)) \
	    $(call option,--force,FORCE)

boot: | setup-tests ## boot a robot's image in QEMU on this terminal
	$(Q)$(FLOTILLA) boot --robot $(call need,ROBOT)

ssh: | setup ## shell on a robot, or on its guest when one runs: make ssh ROBOT=3
	$(Q)$(FLOTILLA) ssh --robot $(call need,ROBOT)

verify: | setup ## build a second time under other circumstances and compare to the byte
	$(Q)$(FLOTILLA) verify --robot $(call need,ROBOT)

size: | setup ## the largest packages and files of a robot's image
	$(Q)$(FLOTILLA) size --robot $(call need,ROBOT)

##@ Fleet
.PHONY: fleet fleet-status fleet-down fleet-scale provision
fleet: | setup-tests ## a virtual fleet of guests in the background, to try things on: make fleet N=4
	$(Q)$(PYTHON) -m tests.lab.fleet up $(call need,N)

fleet-status: | setup-tests ## what the guests of the virtual fleet do
	$(Q)$(PYTHON) -m tests.lab.fleet status

fleet-down: | setup-tests ## end the virtual fleet
	$(Q)$(PYTHON) -m tests.lab.fleet down

fleet-scale: | setup-tests ## how provisioning grows with the fleet, on light robots, as root: make fleet-scale N=32 [BOARD=]
	$(Q)$(PYTHON) -m tests.lab.scale measure $(call need,N) $(call option,--board,BOARD)

provision: | setup ## robots become what the inventory says: make provision [ROBOT=3] [ON=guests] [ARGS=--check]
	$(Q)cd ansible && export PATH="$(abspath $(VENV))/bin:$$PATH" BUILD="$(abspath $(BUILD))" && \
	    $(if $(KEYS),KEYS="$(abspath $(KEYS))") ansible-playbook -i inventory \
	    $(if $(filter guests,$(ON)),-i $(abspath $(BUILD))/fleet/guests.yml -l $(if $(value ROBOT),robot$(call given,ROBOT),guests), \
	        $(if $(value ROBOT),-l robot$(call given,ROBOT))) $(call each_given,ARGS) $(if $(value PLAYBOOK),$(call given,PLAYBOOK),fleet).yml

##@ Apps
.PHONY: new-app deploy
new-app: | setup ## a working start of an app, in apps/NAME: make new-app KIND=block|ert|fmu|make NAME=hover
	$(Q)$(FLOTILLA) new-app --kind $(call need,KIND) --name $(call need,NAME)

deploy: | setup ## build, send and run an app: ROBOT=3 APP=dir [BUILD=remote] [KEEP=1 | RUN=start|stop|status|log|remove]
	$(Q)$(FLOTILLA) deploy --robot $(call need,ROBOT) --app $(call need,APP) $(call option,--run,RUN) \
	    $(if $(filter-out 0,$(KEEP)),--keep) $(if $(filter-out 0,$(ON_ROBOT)),--on-robot)

##@ Inputs
.PHONY: lock check-fleet requirements
lock: | setup ## resolve the package lists against the mirror: exact versions and hashes
	$(Q)$(FLOTILLA) lock

check-fleet: | setup ## validate the fleet's description
	$(Q)$(FLOTILLA) check-fleet

requirements: | setup ## lock the Python environment anew from requirements.in
	$(Q)$(VENV)/bin/uv pip compile --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
	    --no-header --no-annotate --quiet requirements.in -o requirements.lock

##@ Quality
.PHONY: check test test-all bench
check: | setup-tests ## lint, types and unit tests, of the runtime too; no images, no QEMU
	$(Q)$(VENV)/bin/ruff format --check .
	$(Q)$(VENV)/bin/ruff check .
	$(Q)$(VENV)/bin/mypy
	$(Q)$(VENV)/bin/mypy ansible/library ansible/plugins
	$(Q)$(call shell_scripts) | xargs shellcheck
	$(Q)cd ansible && PATH="$(abspath $(VENV))/bin:$$PATH" ansible-lint --offline -q .
	$(Q)$(MAKE) check-runtime
	$(Q)$(VENV)/bin/pytest -q tests/unit

tests = tests --ignore=tests/unit --durations=20 --durations-min=10
test: | setup-tests ## checks, a short fuzzing, images, boots in QEMU: everything but what test-all adds
	$(Q)$(MAKE) -j2 test-kernel test-images
	@# Both, whatever the first one says.
	$(Q)$(VENV)/bin/pytest $(tests) -m 'alone and not long'; status=$$?; \
	    $(VENV)/bin/pytest $(tests) -m 'not alone and not long' -n 2 --dist loadfile && exit $$status

# The kernel takes longest, and gets what checks and images leave of the processors.
.PHONY: test-kernel test-images
test-kernel: | setup-tests
	$(Q)nice -n 19 $(FLOTILLA) kernel --board smartcoret3

# Without make's job server, which ninja cannot use from here.
test-images: | setup-tests
	$(Q)MAKEFLAGS= $(MAKE) --no-print-directory check
	@# With a seed, so that whoever changed nothing finds nothing.
	$(Q)MAKEFLAGS= $(MAKE) --no-print-directory fuzz SECONDS=3 SEED=1
	$(Q)$(FLOTILLA) image --all

test-all: test ## the same, and tests that take minutes for one answer
	$(Q)images/install-host-packages tests/browser-packages.txt
	$(Q)$(VENV)/bin/pytest tests -m long

bench: | setup-tests ## wall times and ratios against other builders
	$(Q)$(FLOTILLA) bench $(call option,--robot,ROBOT)

##@ Runtime
.PHONY: runtime check-runtime fuzz bench-runtime param record live top
meson = PATH="$(abspath $(VENV))/bin:$$PATH" meson
# What a compiler says matters when it fails.
compile = $(meson) compile -C $1 $2 >$1/compile.log || { cat $1/compile.log >&2; exit 1; }
runtime: | setup-tests ## the runtime's programs for this computer, in build/runtime
	$(Q)test -f $(BUILD)/runtime/build.ninja || $(meson) setup $(BUILD)/runtime runtime >/dev/null
	$(Q)$(call compile,$(BUILD)/runtime)

check-runtime: | setup-tests ## format of all C, the runtime's clang-tidy and unit tests with AddressSanitizer and UBSan
	$(Q)git ls-files '*.[ch]' | xargs $(VENV)/bin/clang-format --dry-run -Werror
	$(Q)test -f $(BUILD)/runtime-sanitized/build.ninja || $(meson) setup $(BUILD)/runtime-sanitized runtime -Dtests=true \
	    -Db_sanitize=address,undefined -Dbuildtype=debugoptimized >/dev/null
	$(Q)$(call compile,$(BUILD)/runtime-sanitized)
	$(Q)$(PYTHON) -m tests.tidy $(BUILD)/runtime-sanitized
	$(Q)$(meson) test -C $(BUILD)/runtime-sanitized --no-rebuild --print-errorlogs --quiet

fuzz: | setup-tests ## the runtime's parsers: a million streams each, then libFuzzer [SECONDS=60 SEED=]; finds go to build/found
	$(Q)images/install-host-packages tests/fuzz-packages.txt
	$(Q)test -f $(BUILD)/fuzz/build.ninja || CC=clang $(meson) setup $(BUILD)/fuzz runtime -Dtests=true -Dfuzz=true \
	    -Dbuildtype=debugoptimized >/dev/null
	$(Q)$(call compile,$(BUILD)/fuzz,fuzzers)
	$(Q)$(meson) test -C $(BUILD)/fuzz --suite fuzz --no-rebuild --print-errorlogs --quiet
	$(Q)set -e; for known in runtime/tests/fuzz/corpus/*; do \
	    name=$${known##*/}; found=$(BUILD)/found/$$name; \
	    mkdir -p $$found; echo "$$name:" $(if $(value SECONDS),$(call given,SECONDS),60) s; \
	    $(BUILD)/fuzz/tests/fuzz/fuzz_$$name -max_total_time=$(if $(value SECONDS),$(call given,SECONDS),60) $(if $(value SEED),-seed=$(call given,SEED)) -max_len=1024 -timeout=10 -verbosity=0 \
	        -artifact_prefix=$$found- $$found $$known 2>$$found.log || { cat $$found.log >&2; exit 1; }; done

bench-runtime: | setup-tests runtime ## what a block costs, beside LinuxCNC's HAL, in one run [SECONDS=2 ROUNDS=5]
	$(Q)images/install-host-packages runtime/bench/packages.txt
	$(Q)$(PYTHON) -m runtime.bench.bench $(BUILD)/runtime/flotilla-run $(call option,--seconds,SECONDS) \
	    $(call option,--rounds,ROUNDS)

# One program receives, since a port can be received at only once: what it does with it is told by variables too.
station = $(PYTHON) -m runtime.station $(call option,--seconds,SECONDS) $(call option,--live-address,ADDRESS)
record: | setup ## what robots tell this station, as an MCAP file for Foxglove or PlotJuggler: make record [OUT=file] [SECONDS=]
	$(Q)$(station) --record $(call each_given,OUT) $(call option,--live,PORT)

live: | setup ## serve it to Foxglove while it comes [PORT=8765 ADDRESS=127.0.0.1]; record it too: OUT=file
	$(Q)$(station) --live $(call each_given,PORT) $(call option,--record,OUT)

top: | setup ## how it comes: rate, link, age, flags; keys act on tasks [SECONDS=]; also how tasks run: ASK=1; OUT=, PORT= as above
	$(Q)$(station) --top $(if $(filter-out 0,$(ASK)),--ask) $(call option,--record,OUT) $(call option,--live,PORT)

param: | setup ## parameters of a task or an app that runs: make param ROBOT=1 TASK=heading [PARAM=attitude.kp [VALUE=2.5]]
	$(Q)$(FLOTILLA) param --robot $(call need,ROBOT) $(call need,TASK) $(if $(value PARAM),$(call given,PARAM) $(call option,--,VALUE))

##@ Real time
.PHONY: latency latency-accept boot-time hwcheck scenarios scenarios-accept
LATENCY = $(PYTHON) -m tests.latency
# What is measured: the board's system with each kernel, or one of them, or less of it, or a robot.
measured = --board $(if $(value BOARD),$(call given,BOARD),smartcoret3) $(call option,--kernel,KERNEL) $(call option,--plan,PLAN)
latency: | setup-tests ## latency in virtual time within its limits, a control refused [BOARD= KERNEL=lean|debian|no-rt PLAN=quick|disk]; or TARGET=ssh:robot3
	$(Q)$(LATENCY) measure $(measured) $(call option,--target,TARGET)
	$(if $(TARGET),,$(Q)$(LATENCY) compare $(measured))

hwcheck: | setup ## a robot's hardware in one file, to send with a bug report: make hwcheck ROBOT=3
	$(Q)$(FLOTILLA) hwcheck --robot $(call need,ROBOT) $(call option,--seconds,SECONDS)

latency-accept: | setup-tests ## measure both kernels, or KERNEL=, and a control loop, and make that the accepted latency [BOARD=]
	$(Q)$(LATENCY) accept $(measured)
	$(Q)$(PYTHON) -m tests.virtual_loop

boot-time: | setup-tests ## where a boot spends its time, in virtual time
	$(Q)$(LATENCY) boot-time $(measured)

scenarios: | setup-tests ## a robot flown by four computers, links that lose or are cut: a report [SIDE=1] [FLIGHTS="udp dds"] [ON=guests | ROBOTS=16]
	$(Q)$(PYTHON) -m tests.scenarios $(if $(filter guests,$(ON)),--guests) $(call option,--robots,ROBOTS) $(call option,--side,SIDE) $(call each_given,FLIGHTS)

scenarios-accept: | setup-tests ## make a new run the accepted one: commit tests/scenarios/baseline.json
	$(Q)$(PYTHON) -m tests.scenarios --accept

##@ Housekeeping
.PHONY: setup setup-tests clean help
setup: $(VENV)/.complete ## install what building needs

setup-tests: setup ## install what testing needs
	$(Q)images/install-host-packages tests/host-packages.txt

$(VENV)/.complete: requirements.lock requirements-source.lock images/host-packages.txt
	$(Q)images/install-host-packages images/host-packages.txt
	$(Q)rm -rf $(VENV)
	$(Q)python3 -m venv $(VENV)
	$(Q)$(VENV)/bin/pip install --quiet --require-hashes --only-binary :all: -r requirements.lock
	$(Q)$(VENV)/bin/pip install --quiet --require-hashes --no-deps --no-build-isolation --use-pep517 \
	    -r requirements-source.lock
	$(Q)touch $@

clean: ## remove all outputs; keys stay
	$(Q)rm -rf $(BUILD)

help: ## this list
	@awk -F ':.*## ' '/^##@/ {printf "\n%s\n", substr($$0, 5)} /^[a-z-]+:.*## / {printf "  %-14s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

# What somebody gave reaches a program as it stands, as one word or as several: no shell reads it as a command.
quoted = '$(subst ','\'',$1)'
given = $(call quoted,$(value $1))
each_given = $(foreach each,$(value $1),$(call quoted,$(each)))
option = $(if $(value $2),$1 $(call given,$2))
need = $(if $(value $1),$(call given,$1),$(error say which: make $@ $1=…))
shell_scripts = git grep -l -E '^\#!/bin/(ba)?sh' -- images rootfs_overlay tests .ci
