#!/usr/bin/env bash
# The master, inside of its job step: as many threads as the step has CPUs.
#
#   RUN_DIR=... master.sh [SETTING...]
set -euo pipefail

# shellcheck source-path=SCRIPTDIR source=lib.sh
source "$PROJECT/slurm/lib.sh"

threads=${SLURM_CPUS_PER_TASK:-1}
export OMP_NUM_THREADS=$threads MKL_NUM_THREADS=$threads OPENBLAS_NUM_THREADS=$threads
become tangram-master "$(setting run_dir "$RUN_DIR")" resume=auto "service.threads=$threads" "$@"
