# What the job scripts share. They source it, after PROJECT, RUN_DIR and RUN_WITH are set, and run
# under set -euo pipefail.
# shellcheck shell=bash

UNAVAILABLE_STATUS=75 # the environment lacks something, and may have it again by itself
MOST_WAIT_S=300
LOOK_S=2 # between two looks, for a file or a signal
GOODBYE_S=15 # for workers to leave after the master, before the job ends and takes them along

RUN_DIR=$(realpath -m -- "$RUN_DIR")
export PROJECT RUN_DIR RUN_WITH
# shellcheck source-path=SCRIPTDIR source=code.sh
source "$PROJECT/slurm/code.sh"
# An image brings a PATH of its own.
export PATH="$PROJECT/.venv/bin:$PATH"

master=  # process of the srun that runs the master
warned=  # 1 once the time limit is near

say() {
    echo "$(date '+%F %T') $*"
}

# Why the run ended, as its master has written it; empty while it has not.
ended_by() {
    sed -nE 's/^ *"ended_by": *"([^"]*)".*/\1/p' "$RUN_DIR/result.json" 2>/dev/null || true
}

# Whether the run has reached a bound: max_updates, max_episodes or max_hours.
finished() {
    [[ $(ended_by) == max_* ]]
}

# Becomes a command of the project, inside of the image where there is one.
become() {
    local -a front
    read -ra front <<<"$RUN_WITH"
    exec "${front[@]}" "$@"
}

# The folder, without what an earlier life of the run would mislead workers with.
begin_run() {
    mkdir -p "$RUN_DIR/logs"
    rm -f "$RUN_DIR/connection.json"
    [[ ! -e $RUN_DIR/result.json ]] || mv "$RUN_DIR/result.json" "$RUN_DIR/result.before.json"
    say "job $SLURM_JOB_ID, start $((${SLURM_RESTART_COUNT:-0} + 1)), run folder $RUN_DIR"
    trap warn_master USR1
}

# The master as a step of its own: start_master [OPTION OF SRUN...] -- [SETTING...]
start_master() {
    local -a options=()
    while [[ $1 != -- ]]; do
        options+=("$1")
        shift
    done
    shift
    code_of "$@"
    srun --exact --nodes=1 --ntasks=1 "${options[@]}" --open-mode=append \
        --output="$RUN_DIR/logs/master.%j.log" "$PROJECT/slurm/master.sh" "$@" &
    master=$!
}

# A worker as a step of its own, so that one that dies or is cancelled takes no other along:
# start_worker NAME [OPTION OF SRUN...] -- [SETTING...]
start_worker() {
    local name=$1
    local -a options=()
    shift
    while [[ $1 != -- ]]; do
        options+=("$1")
        shift
    done
    shift
    # --gres=none: the master's step keeps the job's GPU.
    srun --exact --nodes=1 --ntasks=1 --cpus-per-task=1 --gres=none "${options[@]}" \
        --job-name="$name" --open-mode=append --output="$RUN_DIR/logs/$name.%j.%t.log" \
        "$PROJECT/slurm/worker.sh" "$@" "${code[@]}" &
}

warn_master() {
    warned=1
    say "the time limit is near: the master ends with a checkpoint"
    [[ -z $master ]] || kill -USR1 "$master" 2>/dev/null || true
}

# Wait for a process whatever signals come meanwhile; its exit status is left in `status`.
await() {
    while true; do
        status=0
        wait "$1" || status=$?
        # A trap ends a wait, too: then the process is still there.
        if ((status <= 128)) || ! kill -0 "$1" 2>/dev/null; then
            return 0
        fi
    done
}

# Whether to start again what ended with `status`, because the environment lacked something. Waits
# before, twice as long each time in a row, unless a signal sets `leaving`.
leaving=
wait_s=1
try_later() { # WHO
    local slept
    ((status == UNAVAILABLE_STATUS)) || return 1
    wait_s=$((2 * wait_s < MOST_WAIT_S ? 2 * wait_s : MOST_WAIT_S))
    say "$1 ended with status $status: it is started again in $wait_s s"
    for ((slept = 0; slept < wait_s; slept += LOOK_S)); do
        sleep "$LOOK_S"
        [[ -z $leaving ]] || return 1
    done
}

# Until the run has ended; queues the job again where the time limit cut it short.
follow_master() {
    await "$master"
    say "the master ended with status $status ($(ended_by))"
    local until_s=$((SECONDS + GOODBYE_S))
    while [[ -n $(jobs -rp) ]] && ((SECONDS < until_s)); do
        sleep 0.5
    done
    end_job
}

end_job() {
    if finished; then
        say "the run is complete: $(ended_by)"
        exit 0
    fi
    if [[ -z $warned ]]; then
        say "the run is not complete: submit the job again with RUN_DIR=${RUN_DIR@Q} to go on"
        exit "$status"
    fi
    say "the run is not complete: the job is queued again"
    if ! scontrol requeue "$SLURM_JOB_ID"; then
        say "this cluster does not queue it again: submit it again with RUN_DIR=${RUN_DIR@Q} to go on"
        exit 1
    fi
}
