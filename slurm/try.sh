#!/usr/bin/env bash
# Tries every script of this folder on a real SLURM, made on this machine and taken away again.
#
#   slurm/try.sh [node] [limit] [tasks]      # all three parts without an argument
#
# Needs Debian and root: it installs slurm-wlm and munge where they are missing (they stay), and runs
# their daemons with a configuration in a temporary folder; /etc/slurm is left alone. Takes about a
# quarter of an hour. Prints what held and what did not, and fails if anything did not. KEEP=1 leaves
# the temporary folder.
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/.."
PROJECT=$PWD
export PROJECT
PATIENCE_S=${TRY_PATIENCE_S:-900} # for what takes long; a busy machine takes longer

# shellcheck source-path=SCRIPTDIR source=trycluster.sh
source slurm/trycluster.sh
# shellcheck source-path=SCRIPTDIR source=tryparts.sh
source slurm/tryparts.sh

failed=0

# held TEXT COMMAND...: one line for what was to be seen.
held() {
    local text=$1
    shift
    if "$@"; then
        echo "held: $text"
    else
        echo "NOT held: $text"
        failed=$((failed + 1))
    fi
}

refuse() {
    echo "try.sh: $1" >&2
    exit 2
}

clean_up() {
    stop_cluster
    if [[ -n ${KEEP:-} ]]; then
        echo "kept: $work"
    else
        rm -rf "$work"
    fi
}

nothing_left() {
    local left
    left=$(left_processes)
    [[ -z $left && ! -e $work ]] || { echo "  left: $left $(ls -d "$work" 2>/dev/null)"; return 1; }
}

[[ $EUID -eq 0 ]] || refuse "must run as root: it installs packages and starts daemons"
[[ -e /etc/debian_version ]] || refuse "must run on Debian: it installs packages with apt-get"
for part in "$@"; do
    [[ $part =~ ^(node|limit|tasks)$ ]] || refuse "unknown part '$part': node, limit or tasks"
done

work=$(mktemp -d /tmp/tangram-slurm.XXXXXX)
trap clean_up EXIT
trap 'exit 130' INT
trap 'exit 143' TERM

install_slurm || refuse "cannot install slurm-wlm and munge"
# Fetch's environments are in no environment that only `make train` made.
.venv/bin/python -c 'import gymnasium_robotics' 2>/dev/null ||
    .ci/install .venv robotics || refuse "cannot install the extra robotics into .venv"
start_cluster || refuse "SLURM does not start: see $(tail -n 5 "$work"/*.out)"
echo "$(slurmd -V) on Debian $(</etc/debian_version), two nodes on $(nproc) cores"

for part in "${@:-node limit tasks}"; do
    for name in $part; do
        "try_$name"
    done
done

trap - EXIT
clean_up
[[ -n ${KEEP:-} ]] || held "no process and no file is left behind" nothing_left
if ((failed)); then
    echo "$failed not held"
    exit 1
fi
echo "everything held"
