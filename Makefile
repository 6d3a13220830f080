# The front door: `make image ROBOT=3` runs `flotilla make image`, which reads the variables. flotilla/cli declares them.
# `make help` shows the targets that people use; V=1 shows the commands.
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
export BUILD
# Names of files are UTF-8 in any user's locale: the virtual environment has the path of the checkout in its files.
export LC_ALL := C.UTF-8
PYTHON := $(VENV)/bin/python
FLOTILLA := $(PYTHON) -m flotilla
# Progress of a part of a command: a live line on a terminal, else a line at its end; its output if it fails.
step = $(PYTHON) -m flotilla.common.progress
Q := $(if $(filter-out 0,$(V)),,@)
# Python imports no packages of the user's, and pip puts none among them.
unexport PYTHONHOME PYTHONPATH PIP_PREFIX PIP_TARGET PIP_USER
MAKEFLAGS += --no-print-directory
.DEFAULT_GOAL := help
goals := $(or $(MAKECMDGOALS),help)

# Targets that run a command, by the group of Python packages in requirements/ that it needs. The command itself installs
# its Debian packages.
build_targets := admit-operator backup-keys boot boot-time bundle check-fleet cve deploy fetch flash hwcheck image images \
    import-model init kernel latency latency-accept lock new-app operators param provision releases restore-keys \
    revoke-key revoke-operator rotate-key scope size ssh station-join station-leave station-time update verify verify-bundle
station_targets := accept convert drive fleet fleet-down fleet-scale fleet-status live positions power-cuts radio-capacity \
    record report scenarios scenarios-accept station top wheeled wheeled-down
# Variables of all targets.
variables_of_all := MIRROR SECURITY_MIRROR SNAPSHOT FLEET BUILD KEYS APPS INVENTORY ANY_HOST PYTHON3 V
# These targets have a fixed fleet, so FLEET and INVENTORY are errors.
with_own_fleet := wheeled wheeled-down scenarios
variables_help := TARGET
include $(wildcard tests/development.mk)

# With sudo, the files that make writes would belong to root; flotilla/common/sudo.py has the same message.
as_root := $(if $(filter-out 0,$(value SUDO_UID)),$(filter-out fleet-scale help,$(goals)))
$(if $(as_root),$(if $(filter 0,$(shell id -u)),$(if $(filter 0,$(shell stat -c %u .)),,$(error make $(as_root) needs no root: \
    run it without sudo))))
$(foreach name,FLEET INVENTORY,$(if $(and $(value $(name)),$(filter $(with_own_fleet),$(goals))),\
    $(error $(name)=$(value $(name)): $(goals) has a fleet of its own; leave $(name) out)))

# Variables of the command line reach programs verbatim, in the environment. Their names are checked once: by the command,
# or here if no target runs one.
names := $(foreach name,$(.VARIABLES),$(if $(filter command,$(firstword $(origin $(name)))),$(name)))
$(foreach name,$(names),$(eval override export $(name) := $$(value $(name))))
known := $(foreach goal,$(goals),$(variables_$(goal)))
unknown := $(if $(filter-out 0,$(MAKELEVEL)),,$(filter-out $(variables_of_all) $(known),$(names)))
$(if $(and $(unknown),$(if $(filter $(build_targets) $(station_targets),$(goals)),,yes)),$(error make $(goals) $(firstword \
    $(unknown))=…: there is no such variable; $(if $(known),take $(known),none is needed)))
export MAKE_GOALS := $(goals)
export MAKE_NAMES := $(filter-out $(variables_of_all) $(known),$(if $(filter-out 0,$(MAKELEVEL)),,$(names)))

.PHONY: $(build_targets) $(station_targets)
$(build_targets): | setup
$(station_targets): | setup-station
$(build_targets) $(station_targets):
	$(Q)$(FLOTILLA) make $@

##@ Setup
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

setup-lab: setup ## install what QEMU guests need
	$(Q)images/install-host-packages flotilla/lab/host-packages.txt

setup-runtime: setup ## install what compiling the runtime needs
	$(Q)images/install-host-packages runtime/host-packages.txt

setup-tests: $(VENV)/.tests ## install what the tests need
	$(Q)images/install-host-packages tests/host-packages.txt flotilla/lab/host-packages.txt runtime/host-packages.txt

clean: ## remove all outputs except keys
	$(Q)rm -rf $(BUILD)

help: ## show the usual targets, or the variables of one, or all targets | [TARGET=flash|all]
	@awk 'BEGIN {target = ENVIRON["TARGET"]} /^==( |$$)/ {on = $$2 == target; found = found || on; next} on; END {if (!found) { \
	    print "TARGET=" target ": no such target; see make help TARGET=all" >"/dev/stderr"; exit 2}}' docs/reference/targets.txt

# One word for a shell, verbatim.
quoted = '$(subst ','\'',$1)'
