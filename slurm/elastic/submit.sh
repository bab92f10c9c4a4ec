#!/usr/bin/env bash
# Submits the master of a run, and an evaluator and workers that start once it has.
#
#   slurm/elastic/submit.sh [SETTING OF TANGRAM-MASTER...]
#   RUN_DIR=runs/shared WORKERS=64 slurm/elastic/submit.sh seed=1 max_updates=200000
set -euo pipefail

# Folder of the run, on a file system that all nodes share.
RUN_DIR=${RUN_DIR:-runs/elastic-$(date +%Y-%m-%d_%H-%M-%S)}
# How many may play at a time.
WORKERS=${WORKERS:-8}
# Options of sbatch, such as "--partition=gpu --gres=gpu:1" and "--partition=preemptible".
MASTER_OPTIONS=${MASTER_OPTIONS:-}
WORKER_OPTIONS=${WORKER_OPTIONS:-}

export RUN_DIR PROJECT="${PROJECT:-$PWD}"
if [[ ! -e $PROJECT/slurm/lib.sh ]]; then
    echo "submit.sh: $PROJECT is no checkout of the project: go there, or set PROJECT" >&2
    exit 2
fi
read -ra master_options <<<"$MASTER_OPTIONS"
read -ra worker_options <<<"$WORKER_OPTIONS"

master=$(sbatch --parsable "${master_options[@]}" "$PROJECT/slurm/elastic/master.sbatch" "$@")
# shellcheck source-path=SCRIPTDIR source=../code.sh
source "$PROJECT/slurm/code.sh"
code_of "$@"
workers=$(sbatch --parsable --dependency="after:$master" --array="0-$WORKERS" \
    "${worker_options[@]}" "$PROJECT/slurm/elastic/workers.sbatch" "${code[@]}")
echo "master: job $master, evaluator and workers: job $workers, run folder: $RUN_DIR"
printf 'see how it stands with: tangram-status %q\n' "$(setting connect "$RUN_DIR")"
