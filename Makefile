# make install | test | benchmark | check-results | docs: each does its set-up in .venv by itself.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
WORKERS ?= 2
BIN := .venv/bin
STAMP := .venv/.installed
EXTRAS := open3d,peers,gtsam,ros,train,rllib,explore,ray,report,record,view,energy,video,docs,dev
SYSTEM_LIBRARIES := libusb-1.0-0 libgl1
# One thread per process: the tests and the benchmark run in parallel processes.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1

# What also runs in a checked build, where every index of a kernel is compared with its array.
CHECKED_TESTS := tests/slam/test_any_size.py tests/slam/test_fusion.py \
    tests/slam/test_frustum_culling.py tests/sensor/test_depth_noise.py \
    tests/sensor/test_shading.py tests/divergence/test_batched_divergence.py \
    tests/planning/test_occupancy_grid.py tests/env/test_reward_and_coverage.py

.PHONY: install test benchmark check-results docs lint types clean

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "installing into .venv (a few minutes the first time)"
	@$(BIN)/python -m pip install -qq -c constraints.txt -e ".[$(EXTRAS)]"
	@if $(BIN)/python -c 'import ctypes; [ctypes.CDLL(n) for n in ("libusb-1.0.so.0", "libGL.so.1")]' \
	    2>/dev/null; then :; \
	elif [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && apt-get update -qq && \
	    DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends \
	    $(SYSTEM_LIBRARIES) >/dev/null; then :; \
	else echo "Open3D (optional) needs: sudo apt-get install $(SYSTEM_LIBRARIES)"; fi
	@if command -v chromium >/dev/null || command -v google-chrome >/dev/null; then :; \
	elif [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && apt-get update -qq && \
	    DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends \
	    chromium >/dev/null; then :; \
	else echo "Tests of reports in a browser need: sudo apt-get install chromium"; fi
	@touch $@

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(STAMP)
	$(BIN)/mypy

test: lint types
	$(BIN)/pytest -n $(WORKERS) --dist worksteal
	MS_SLAM_ENV_CHECKED=1 $(BIN)/pytest -n $(WORKERS) --dist worksteal $(CHECKED_TESTS)

# Planners in four rooms: the ends of what there is, the paper's, the classical one, the agent shipped.
benchmark: $(STAMP)
	$(BIN)/ms-slam benchmark --task room --planners random stationary greedy nbv agent-room \
	    --episodes 2 --workers $(WORKERS) --out results/benchmark
	@echo "The report, for a browser:"
	@$(BIN)/ms-slam report results/benchmark

# The cheapest row of every committed record again; the same command goes on where it stopped.
LIMIT_MINUTES ?= 60
check-results: $(STAMP)
	$(BIN)/ms-slam experiment check --limit-minutes $(LIMIT_MINUTES)

# The tables of the Markdown pages from docs/results, then the site into site/.
docs: $(STAMP)
	$(BIN)/ms-slam docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "site/index.html"

clean:
	rm -rf .venv build dist *.egg-info results site
