# Two commands on a fresh machine: `make run` and `make test`. `make help` lists the rest.

PYTHON ?= python3
VENV   ?= .venv
# where the CPU build of torch is found (TORCH_INDEX= for the usual index, with CUDA on x86-64)
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
ifneq ($(DESTDIR),)
override DESTDIR := $(abspath $(DESTDIR))
endif
BIN    := $(VENV)/bin
CFLAGS_C := -std=gnu11 -Wall -Wextra -Werror -fno-math-errno -fno-trapping-math
KERNEL_C := $(filter-out csrc/test_%.c, $(wildcard csrc/*.c))
KERNEL := $(wildcard csrc/*.c csrc/*.h) csrc/build_kernel.py setup.py pyproject.toml \
    locagen_edge/mavlink/locagen.xml locagen_edge/mavlink/build_dialect.py
SYSTEMD_DIR := /lib/systemd/system
SYSUSERS_DIR := /usr/lib/sysusers.d
LIB_DIR := /opt/locagen-edge
ETC_DIR := /etc/locagen-edge

# $(call need,PACKAGES,WHY): installs Debian packages that are missing, where it may; else says what to do.
define need
	@missing=; for p in $(1); do dpkg -s $$p >/dev/null 2>&1 || missing="$$missing $$p"; done; \
	if [ -n "$$missing" ]; then \
	    if [ "$$(id -u)" = 0 ]; then sudo=; else sudo="sudo -n"; fi; \
	    echo "installing Debian packages:$$missing ($(2))"; \
	    { $$sudo apt-get install -y -q $$missing || { $$sudo apt-get update -q && $$sudo apt-get install -y -q $$missing; }; } \
	        >/dev/null 2>&1 || echo "could not install$$missing, needed for $(2): sudo apt install$$missing"; \
	fi
endef

# What Python itself may lack on Debian.
define python-needs
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "$(PYTHON) is too old: 3.11 or later is needed"; exit 1; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null || { $(MAKE) -s .python-venv; $(PYTHON) -c 'import ensurepip'; }
	@$(PYTHON) -c 'import os, sysconfig; raise SystemExit(not os.path.exists(sysconfig.get_path("include") + "/Python.h"))' || $(MAKE) -s .python-dev
endef

.PHONY: help
help: ## this list
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 12

# --- for users

.PHONY: run
run: $(VENV)/.flight ## the daemon on a synthetic drone scene; SECONDS=10 ends it by itself
	@exec $(BIN)/locagen-edge run --settings systemd/locagen-edge.toml $(if $(SECONDS),--seconds $(SECONDS))

$(VENV)/.flight: $(KERNEL)
	$(python-needs)
	$(call need,libportaudio2,capture from microphones)
	@test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV)
	@echo "setting up $(VENV) (once)"
	@$(BIN)/pip install -q -e .
	@touch $@

.PHONY: .python-venv .python-dev
.python-venv:
	$(call need,python3-venv,the virtual environment)
.python-dev:
	$(call need,python3-dev,compiling the kernel)

# --- for developers

.PHONY: test
test: $(VENV)/.dev csrc-test csrc-test-threads csrc-test-aarch64 ## sets up and runs all tests
	$(call need,libasound2-dev,tests with a virtual sound card)
	$(call need,pulseaudio pulseaudio-utils libasound2-plugins,tests with a sound server)
	$(BIN)/python -m pytest -n auto --dist loadfile

.PHONY: check
check: $(VENV)/.dev ## lint, format, types: what CI runs before the tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

.PHONY: format
format: $(VENV)/.dev ## rewrites the sources in the one format, the sample settings from their one source
	$(BIN)/ruff check --fix -q . ; $(BIN)/ruff format .
	$(BIN)/python -m locagen_edge.settings > systemd/locagen-edge.toml.tmp && mv systemd/locagen-edge.toml.tmp systemd/locagen-edge.toml
	$(BIN)/python -m locagen_edge.mavlink.build_dialect --docs docs/mavlink.md
	$(BIN)/python -m locagen_edge.mavlink.build_docs docs/mavlink.md

$(VENV)/.dev: $(VENV)/.flight
	@echo "setting up $(VENV) for development (once)"
	@# the CPU build where its index can be reached; where not, whatever the usual index has
	@test -z "$(TORCH_INDEX)" || $(BIN)/pip install -q --no-deps --retries 1 --timeout 15 --extra-index-url $(TORCH_INDEX) torch==2.13.0 2>/dev/null || true
	@$(BIN)/pip install -q -e '.[dev,lab,bench]'
	@touch $@

.PHONY: csrc-test
csrc-test: build/test_kernel ## the kernel's laws in C, under ASan and UBSan
	./build/test_kernel

build/test_kernel: csrc/test_kernel.c $(KERNEL_C) $(wildcard csrc/*.h)
	@mkdir -p build
	$(CC) $(CFLAGS_C) -O1 -g -fsanitize=address,undefined -fno-sanitize-recover=all -Icsrc -o $@ csrc/test_kernel.c $(KERNEL_C) -lm

.PHONY: csrc-test-threads
csrc-test-threads: build/test_threads ## states of their own in threads of their own, under TSan
	./build/test_threads

build/test_threads: csrc/test_threads.c $(KERNEL_C) $(wildcard csrc/*.h)
	@mkdir -p build
	$(CC) $(CFLAGS_C) -O1 -g -fsanitize=thread -Icsrc -o $@ csrc/test_threads.c $(KERNEL_C) -lm -lpthread

.PHONY: csrc-test-aarch64
csrc-test-aarch64: ## the same for aarch64 under qemu-user
	@{ command -v aarch64-linux-gnu-gcc && command -v qemu-aarch64-static; } >/dev/null || { echo "skipped: sudo apt install gcc-aarch64-linux-gnu qemu-user-static"; exit 0; }; \
	mkdir -p build && aarch64-linux-gnu-gcc $(CFLAGS_C) -O3 -static -Icsrc -o build/test_kernel_aarch64 csrc/test_kernel.c $(KERNEL_C) -lm && \
	qemu-aarch64-static build/test_kernel_aarch64

.PHONY: nightly
nightly: $(VENV)/.dev csrc-test csrc-test-threads csrc-test-aarch64 ## the tests with many more and new examples, and on whole machines
	LOCAGEN_NIGHTLY=1 $(BIN)/python -m pytest -n auto --dist loadfile
	PYTHONPATH=. $(BIN)/python tests/mavlink/fuzz.py --inputs 10000000
	$(MAKE) deb-test arm-test vm-test

# $(call deb,ARCHITECTURE): the package's file, as it is named by the one place of the version.
deb = build/deb/locagen-edge_$(shell sed -n 's/^__version__ = "\(.*\)"/\1/p' locagen_edge/__init__.py)_$(1).deb

.PHONY: vm-test
vm-test: deb-arm64 ## the service under systemd on an emulated board: crash, hang, card pulled, limits, stop
	$(call need,qemu-system-arm mmdebstrap cpio,the emulated board)
	$(BIN)/python tests/vm/vm.py $(call deb,arm64)

.PHONY: arm-test
arm-test: deb-arm64 ## replay on aarch64 under qemu-user, beside this machine's
	$(call need,qemu-user-static mmdebstrap,replay on aarch64)
	$(BIN)/python tests/arm/replay.py $(call deb,arm64)

.PHONY: deb-test
deb-test: deb-native ## as root: the package in a clean Debian, from installation to purge
	$(call need,mmdebstrap,a clean Debian)
	$(BIN)/python tests/deb/install.py $(call deb,$(shell dpkg --print-architecture))

.PHONY: bench
bench: $(VENV)/.dev ## speed beside its peers, into bench/results/
	$(call need,libfftw3-dev,comparing with FFTW)
	$(call need,qemu-user mmdebstrap gcc-aarch64-linux-gnu,counting instructions of aarch64)
	$(BIN)/python bench/bench_kernel.py
	$(BIN)/python bench/bench_instructions.py
	$(BIN)/python bench/bench_steered.py
	$(BIN)/python bench/bench_pipeline.py
	$(BIN)/python bench/bench_daemon.py
	$(BIN)/python bench/bench_framer.py
	$(BIN)/python bench/bench_accuracy.py
	$(BIN)/python bench/bench_detection.py
	$(BIN)/python bench/bench_twin.py
	$(BIN)/python bench/bench_position.py
	$(BIN)/python bench/tables.py

.PHONY: models
models: $(VENV)/.dev ## trains the models anew
	$(BIN)/locagen-lab train --settings models/tdoa-mlp.toml --name tdoa-mlp --models models --out build/tdoa-mlp

.PHONY: wireshark
wireshark: $(VENV)/.dev ## a Wireshark dissector of all our messages, build/locagen.lua
	@mkdir -p build
	$(BIN)/python -m locagen_edge.mavlink.build_dialect --lua build/locagen.lua

.PHONY: denoisers
denoisers: $(VENV)/.dev ## trains the denoisers anew on the recordings in SOUNDS, into build/ (hours)
	for k in wave mask; do $(BIN)/locagen-lab denoise train $$k --settings models/denoise-$$k.toml \
	    --calls $(SOUNDS)/signal --noise $(SOUNDS)/noise --out build/denoise-$$k || exit 1; done

.PHONY: paper
paper: $(VENV)/.dev ## repeats the paper's experiments, into paper-report/ (some minutes)
	$(BIN)/locagen-lab paper --out paper-report

# --- the service

.PHONY: deb deb-native deb-arm64
deb: deb-native deb-arm64 ## Debian packages for this machine and for arm64, into build/deb/

deb-native: $(VENV)/.dev
	$(BIN)/python deb/build.py

deb-arm64: $(VENV)/.dev
	$(call need,gcc-aarch64-linux-gnu,cross-compiling the kernel)
	$(BIN)/python deb/build.py --architecture arm64

.PHONY: install
install: ## as root: program, unit, user and sample settings; DESTDIR is honoured
	$(python-needs)
	$(call need,libportaudio2,capture from microphones)
	install -d $(DESTDIR)$(LIB_DIR) $(DESTDIR)$(ETC_DIR) $(DESTDIR)$(SYSTEMD_DIR) $(DESTDIR)$(SYSUSERS_DIR)
	$(PYTHON) -m venv $(DESTDIR)$(LIB_DIR)
	@# built from a copy: root leaves nothing behind in the checkout
	@copy=$$(mktemp -d) && cp -r csrc locagen_edge locagen.py models pyproject.toml setup.py MANIFEST.in README.md LICENSE $$copy && \
	    rm -f $$copy/locagen_edge/*.so $$copy/locagen_edge/mavlink/_messages.py && $(DESTDIR)$(LIB_DIR)/bin/pip install -q $$copy; ok=$$?; rm -rf $$copy; exit $$ok
	@# scripts name their interpreter: the place where it will be, not where it is packed
	@test -z "$(DESTDIR)" || grep -rlI '^#!$(DESTDIR)' $(DESTDIR)$(LIB_DIR)/bin | xargs -r sed -i '1s|^#!$(DESTDIR)|#!|'
	install -m 644 systemd/locagen-edge.service $(DESTDIR)$(SYSTEMD_DIR)/
	install -m 644 systemd/locagen-edge.sysusers $(DESTDIR)$(SYSUSERS_DIR)/locagen-edge.conf
	test -e $(DESTDIR)$(ETC_DIR)/locagen-edge.toml || install -m 644 systemd/locagen-edge.toml $(DESTDIR)$(ETC_DIR)/
	@test -n "$(DESTDIR)" || { systemd-sysusers; systemctl daemon-reload; echo "now: edit $(ETC_DIR)/locagen-edge.toml, then systemctl enable --now locagen-edge"; }

.PHONY: uninstall
uninstall: ## removes all that install brought; the settings stay
	@test -n "$(DESTDIR)" || systemctl disable --now locagen-edge 2>/dev/null || true
	rm -rf $(DESTDIR)$(LIB_DIR)
	rm -f $(DESTDIR)$(SYSTEMD_DIR)/locagen-edge.service $(DESTDIR)$(SYSUSERS_DIR)/locagen-edge.conf
	@test -n "$(DESTDIR)" || systemctl daemon-reload

.PHONY: clean
clean: ## removes what was built, the virtual environment too
	rm -rf build dist *.egg-info $(VENV) locagen_edge/*.so locagen_edge/mavlink/_messages.py
