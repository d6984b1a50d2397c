#!/usr/bin/env bash
# Frames and steps per second on this machine's GPU, in under six minutes: benchmarks/gpu.sh [FOLDER]
# PYTHON names an interpreter that imports ms_slam_env; DEVICE=cpu and BATCHES="1 2" try it out.
set -u
cd "$(dirname "$0")/.." || exit 2
out=${1:-results/gpu}
python=${PYTHON:-.venv/bin/python}
device=${DEVICE:-cuda}
read -ra batches <<<"${BATCHES:-1 16 64 256 1024}"
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
command="import sys; sys.argv[0] = 'ms-slam'; from ms_slam_env.cli import main; sys.exit(main(sys.argv[1:]))"
failed=0

measure() { # SECONDS NAME OPTIONS...: a stage that fails or takes too long does not stop the next
    local limit=$1 name=$2
    shift 2
    timeout "$limit" "$python" -c "$command" experiment "$name" --device "$device" \
        --out "$out/$name" "$@" || failed=1
}

command -v nvidia-smi >/dev/null && nvidia-smi --query-gpu=name,memory.total,driver_version --format=csv
measure 130 slam_batch --batch "${batches[@]}"
measure 220 vector_speed --num-envs "${batches[@]}"
exit "$failed"
