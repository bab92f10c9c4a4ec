#!/usr/bin/env bash
# The master, inside of its job step: as many threads as the step has CPUs. It is started again for as
# long as the environment lacks something, such as room on a disk.
#
#   RUN_DIR=... master.sh [SETTING...]
set -euo pipefail

# shellcheck source-path=SCRIPTDIR source=lib.sh
source "$PROJECT/slurm/lib.sh"

threads=${SLURM_CPUS_PER_TASK:-1}
export OMP_NUM_THREADS=$threads MKL_NUM_THREADS=$threads OPENBLAS_NUM_THREADS=$threads
STEADY_S=60 # one that lived for so long starts with a clean record
child=

leave() { # SIGNAL
    local signal=$1
    leaving=1
    [[ $signal != INT ]] || signal=TERM # bash lets what runs in the background ignore INT
    [[ -z $child ]] || kill "-$signal" "$child" 2>/dev/null || true
}
for signal in TERM INT HUP USR1; do
    # shellcheck disable=SC2064 # the name as it is now
    trap "leave $signal" "$signal"
done

while true; do
    began=$SECONDS
    become tangram-master "$(setting run_dir "$RUN_DIR")" resume=auto "service.threads=$threads" "$@" &
    child=$!
    await "$child"
    child=
    ((SECONDS - began < STEADY_S)) || wait_s=1
    try_later "the master" || exit "$status"
done
