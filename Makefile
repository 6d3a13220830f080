# Front door. `make help` lists the targets; V=1 shows the commands.
BUILD ?= build
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
	$(Q)$(FLOTILLA) flash --robot $(call need,ROBOT) $(if $(CARD),--file $(CARD),--device $(call need,DEV)) $(if $(FORCE),--force $(FORCE))

boot: | setup-tests ## boot a robot's image in QEMU on this terminal
	$(Q)$(FLOTILLA) boot --robot $(call need,ROBOT)

ssh: | setup ## shell on a robot, or on its guest when `make boot` runs: make ssh ROBOT=3
	$(Q)$(FLOTILLA) ssh --robot $(call need,ROBOT)

verify: | setup ## build a second time under other circumstances and compare to the byte
	$(Q)$(FLOTILLA) verify --robot $(call need,ROBOT)

size: | setup ## the largest packages and files of a robot's image
	$(Q)$(FLOTILLA) size --robot $(call need,ROBOT)

##@ Apps
.PHONY: new-app deploy
new-app: | setup ## a working start of an app, in apps/NAME: make new-app KIND=block|ert|make NAME=hover
	$(Q)$(FLOTILLA) new-app --kind $(call need,KIND) --name $(call need,NAME)

deploy: | setup ## build, send and run one until Ctrl-C: make deploy ROBOT=3 APP=dir [KEEP=1 | RUN=start|stop|status|log|remove]
	$(Q)$(FLOTILLA) deploy --robot $(call need,ROBOT) --app $(call need,APP) $(if $(RUN),--run $(RUN)) \
	    $(if $(filter-out 0,$(KEEP)),--keep)

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
.PHONY: check test bench
check: | setup-tests ## lint, types and unit tests, under a minute
	$(Q)$(VENV)/bin/ruff format --check .
	$(Q)$(VENV)/bin/ruff check .
	$(Q)$(VENV)/bin/mypy
	$(Q)$(call shell_scripts) | xargs shellcheck
	$(Q)PATH="$(abspath $(VENV))/bin:$$PATH" $(VENV)/bin/ansible-lint --offline -q ansible
	$(Q)$(MAKE) check-runtime
	$(Q)$(VENV)/bin/pytest -q tests/unit

test: | setup-tests ## everything: checks, images, boots in QEMU
	$(Q)$(MAKE) check
	$(Q)$(FLOTILLA) image --all
	$(Q)$(FLOTILLA) kernel --board smartcoret3
	$(Q)$(VENV)/bin/pytest tests

bench: | setup-tests ## wall times and ratios against other builders
	$(Q)$(FLOTILLA) bench $(if $(ROBOT),--robot $(ROBOT))

##@ Runtime
.PHONY: runtime check-runtime fuzz bench-runtime
meson = PATH="$(abspath $(VENV))/bin:$$PATH" meson
# What a compiler says matters when it fails.
compile = $(meson) compile -C $1 $2 >$1/compile.log || { cat $1/compile.log >&2; exit 1; }
runtime: | setup-tests ## the runtime's programs for this computer, in build/runtime
	$(Q)test -f $(BUILD)/runtime/build.ninja || $(meson) setup $(BUILD)/runtime runtime >/dev/null
	$(Q)$(call compile,$(BUILD)/runtime)

check-runtime: | setup-tests ## the runtime's unit tests, with AddressSanitizer and UBSan
	$(Q)git ls-files 'runtime/*.[ch]' | xargs $(VENV)/bin/clang-format --dry-run -Werror
	$(Q)test -f $(BUILD)/runtime-sanitized/build.ninja || $(meson) setup $(BUILD)/runtime-sanitized runtime -Dtests=true \
	    -Db_sanitize=address,undefined -Dbuildtype=debugoptimized >/dev/null
	$(Q)$(call compile,$(BUILD)/runtime-sanitized)
	$(Q)$(meson) test -C $(BUILD)/runtime-sanitized --no-rebuild --print-errorlogs --quiet

fuzz: | setup-tests ## fuzz the runtime's parsers: make fuzz [SECONDS=60], of each; what is found goes to build/found
	$(Q)images/install-host-packages tests/fuzz-packages.txt
	$(Q)test -f $(BUILD)/fuzz/build.ninja || CC=clang $(meson) setup $(BUILD)/fuzz runtime -Dtests=true -Dfuzz=true \
	    -Dbuildtype=debugoptimized >/dev/null
	$(Q)$(call compile,$(BUILD)/fuzz,fuzzers)
	$(Q)set -e; for fuzzer in $$(find $(BUILD)/fuzz/tests/fuzz -maxdepth 1 -type f -name 'fuzz_*' | sort); do \
	    name=$${fuzzer##*/fuzz_}; found=$(BUILD)/found/$$name; known=runtime/tests/fuzz/corpus/$$name; \
	    mkdir -p $$found; echo "$$name: $(or $(SECONDS),60) s"; \
	    $$fuzzer -max_total_time=$(or $(SECONDS),60) -max_len=1024 -verbosity=0 -artifact_prefix=$$found- $$found \
	        $$(test ! -d $$known || echo $$known) 2>$$found.log || { cat $$found.log >&2; exit 1; }; done

bench-runtime: | setup-tests runtime ## what a block costs, beside LinuxCNC's HAL, in one run [SECONDS=5]
	$(Q)images/install-host-packages runtime/bench/packages.txt
	$(Q)$(PYTHON) -m runtime.bench.bench $(BUILD)/runtime/flotilla-run $(if $(SECONDS),--seconds $(SECONDS))

##@ Real time
.PHONY: latency latency-accept boot-time hwcheck
LATENCY = $(PYTHON) -m tests.latency
# What is measured: the board's shipped system, or another kernel of it, or less of it, or a robot.
measured = --board $(or $(BOARD),smartcoret3) $(if $(KERNEL),--kernel $(KERNEL)) $(if $(PLAN),--plan $(PLAN))
latency: | setup-tests ## latency in virtual time against the accepted one [BOARD= KERNEL= PLAN=quick|disk]; or TARGET=ssh:robot3
	$(Q)$(LATENCY) measure $(measured) $(if $(TARGET),--target $(TARGET))
	$(if $(TARGET),,$(Q)$(LATENCY) compare $(measured))

hwcheck: | setup ## a robot's hardware in one file, to send with a bug report: make hwcheck ROBOT=3
	$(Q)$(FLOTILLA) hwcheck --robot $(call need,ROBOT) $(if $(SECONDS),--seconds $(SECONDS))

latency-accept: | setup-tests ## measure both kernels, or KERNEL=, and make that the accepted latency [BOARD= PLAN=]
	$(Q)$(LATENCY) accept $(measured)

boot-time: | setup-tests ## where a boot spends its time, in virtual time
	$(Q)$(LATENCY) boot-time $(measured)

##@ Housekeeping
.PHONY: setup setup-tests clean help
setup: $(VENV)/.complete ## install what building needs

setup-tests: setup ## install what testing needs
	$(Q)images/install-host-packages tests/host-packages.txt

$(VENV)/.complete: requirements.lock images/host-packages.txt
	$(Q)images/install-host-packages images/host-packages.txt
	$(Q)rm -rf $(VENV)
	$(Q)python3 -m venv $(VENV)
	$(Q)$(VENV)/bin/pip install --quiet --require-hashes --only-binary :all: -r requirements.lock
	$(Q)touch $@

clean: ## remove all outputs; keys stay
	$(Q)rm -rf $(BUILD)

help: ## this list
	@awk -F ':.*## ' '/^##@/ {printf "\n%s\n", substr($$0, 5)} /^[a-z-]+:.*## / {printf "  %-14s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

need = $(or $($1),$(error say which: make $@ $1=…))
shell_scripts = git grep -l -E '^\#!/bin/(ba)?sh' -- images rootfs_overlay tests .ci
