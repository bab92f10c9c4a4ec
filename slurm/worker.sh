#!/usr/bin/env bash
# A worker, inside of its job step: waits for the master, plays, is started again when it fails.
#
#   RUN_DIR=... [STAY=1] worker.sh [SETTING...]
#
# With STAY=1 it outlives the master: it waits for the next one until the run is complete.
set -euo pipefail

STAY=${STAY:-}
PATIENCE_S=${PATIENCE_S:-86400} # for a master that is not there; one of the same job ends with it
STEADY_S=60                    # a worker that lived for so long starts with a clean record
LATE_S=30                      # before an old result counts: a run that is extended clears it
MAX_FAILURES=5                 # in a row
USAGE_STATUS=2                 # of wrong settings, which do not mend themselves

# shellcheck source-path=SCRIPTDIR source=lib.sh
source "$PROJECT/slurm/lib.sh"

export OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
worker=

leave() {
    leaving=1
    [[ -z $worker ]] || kill -TERM "$worker" 2>/dev/null || true
}
trap leave TERM INT USR1

await_master() {
    local began=$SECONDS
    while [[ ! -e $RUN_DIR/connection.json ]]; do
        [[ -z $leaving ]] || exit 0
        if ((SECONDS - began >= LATE_S)) && finished; then
            say "the run is complete: $(ended_by)"
            exit 0
        fi
        if ((SECONDS - began >= PATIENCE_S)); then
            say "no master wrote $RUN_DIR/connection.json within $PATIENCE_S s: the worker leaves"
            exit 1
        fi
        sleep "$LOOK_S"
    done
}

failures=0
unavailable=
while true; do
    await_master
    began=$SECONDS
    become tangram-worker "$(setting connect "$RUN_DIR")" "$@" &
    worker=$!
    await "$worker"
    [[ -z $leaving ]] || exit 0
    if ((status == 0)); then
        if [[ -z $STAY ]] || finished; then
            exit 0
        fi
        failures=0
        say "the master has ended ($(ended_by)): the worker waits for the next one"
        continue
    fi
    ((SECONDS - began < STEADY_S)) || failures=0 wait_s=1
    # It waits for ten minutes itself where a master is gone.
    ((status == UNAVAILABLE_STATUS && SECONDS - began < 15 * STEADY_S)) || unavailable=
    if ((status == UNAVAILABLE_STATUS)); then
        unavailable=${unavailable:-$SECONDS}
        if ((SECONDS - unavailable >= PATIENCE_S)); then
            say "no master let the worker in within $PATIENCE_S s: it leaves"
            exit "$status"
        fi
    fi
    if try_later "the worker"; then
        continue
    fi
    [[ -z $leaving ]] || exit 0
    failures=$((failures + 1))
    if ((status == USAGE_STATUS || failures > MAX_FAILURES)); then
        say "the worker ended with status $status: given up"
        exit "$status"
    fi
    say "the worker ended with status $status: it is started again ($failures of $MAX_FAILURES)"
    sleep $((failures * LOOK_S))
done
