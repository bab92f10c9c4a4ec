#!/usr/bin/env bash
# Tries the images and docker-compose.yml for real, from nothing, as root on Debian.
#
#   docker/try.sh
#
# Installs docker.io and docker-compose, starts a docker daemon of its own where none runs, makes a
# base image with debootstrap where no registry is reached, and prints line by line what held. Ends
# with status 1 if anything did not. Containers, images, volumes, the daemon and what it did to the
# network are gone afterwards; Debian's packages stay.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"

WAIT_S=240
STARTED_S=$SECONDS
NOT_HELD=0
WORK=$(mktemp -d)
SAID=$WORK/said
DAEMON=

held() {  # held TEXT COMMAND...: whether the command succeeds, in a line
    local text=$1
    shift
    if "$@" >"$SAID" 2>&1; then
        printf '%4d s  held      %s\n' $((SECONDS - STARTED_S)) "$text"
    else
        printf '%4d s  NOT HELD  %s\n' $((SECONDS - STARTED_S)) "$text"
        tail -n 5 "$SAID" | sed 's/^/                  /'
        NOT_HELD=$((NOT_HELD + 1))
    fi
}

eventually() {  # eventually COMMAND...: until it succeeds, or the patience is over
    local until_s=$((SECONDS + WAIT_S))
    until "$@"; do
        ((SECONDS < until_s)) || return 1
        sleep 1
    done
}

fail() {
    echo "try.sh: $1" >&2
    exit 1
}

clean_up() {
    set +e
    compose down --volumes --remove-orphans --timeout 20 >/dev/null 2>&1
    docker rmi --force "$BASE" tangram-worker tangram-master-cpu tangram-test >/dev/null 2>&1
    [[ -n ${OWN_WHEEL:-} ]] && rm -f "wheels/$OWN_WHEEL"
    if [[ -n $DAEMON ]]; then
        kill "$DAEMON"
        wait "$DAEMON"
        restore_network
    fi
    rm -rf --one-file-system "$WORK"
}

# A daemon leaves its bridge, its firewall rules and forwarding behind when it ends.
restore_network() {
    [[ $(links) == *docker0* && $LINKS != *docker0* ]] && ip link delete docker0
    local table
    for table in filter nat; do
        iptables --table "$table" --flush
        iptables --table "$table" --delete-chain
    done
    iptables --policy FORWARD ACCEPT
    iptables-restore <<<"$FIREWALL"
    echo "$FORWARDING" >/proc/sys/net/ipv4/ip_forward
}

links() { ip -oneline link | cut -d: -f2; }
rules() { grep '^-A' || true; }

nothing_left() {
    [[ ! -e $WORK && ! -e wheels/${OWN_WHEEL:-none} ]] || return 1
    if [[ -n $DAEMON ]]; then
        ! kill -0 "$DAEMON" && [[ $(links) == "$LINKS" ]] &&
            [[ $(iptables-save | rules) == $(rules <<<"$FIREWALL") ]]
    else
        [[ -z $(docker images --quiet "$BASE") ]] &&
            [[ -z $(docker volume ls --quiet --filter name=tangram-try) ]]
    fi
}

compose() { docker-compose "$@"; }

# ---- what is needed ------------------------------------------------------------------------------
[[ $EUID -eq 0 ]] || fail "must be root, to install packages and to start a docker daemon"
command -v apt-get >/dev/null || fail "needs Debian: apt-get is not here"
packages=(docker.io docker-compose debootstrap curl iproute2 iptables)
dpkg --status "${packages[@]}" >/dev/null 2>&1 ||
    { apt-get update -qq && apt-get install -y -qq --no-install-recommends "${packages[@]}" >/dev/null; } ||
    fail "cannot install ${packages[*]}"

export COMPOSE_PROJECT_NAME=tangram-try RUN=run
export METRICS_PORT=19090 TENSORBOARD_PORT=16006
export SETTINGS="max_updates=0 service.eval_seconds=3 service.checkpoint_minutes=0.2"
export BASE=python:3.11-slim-bookworm
trap 'echo "try.sh: ended by line $LINENO" >&2' ERR
trap clean_up EXIT

if ! docker info >/dev/null 2>&1; then
    LINKS=$(links) FIREWALL=$(iptables-save) FORWARDING=$(</proc/sys/net/ipv4/ip_forward)
    export DOCKER_HOST=unix://$WORK/docker.sock
    dockerd --data-root "$WORK/data" --exec-root "$WORK/exec" --pidfile "$WORK/pid" \
        --host "$DOCKER_HOST" >"$WORK/dockerd.log" 2>&1 &
    DAEMON=$!
    eventually docker info >/dev/null 2>&1 || fail "dockerd does not start: $(tail -n 3 "$WORK/dockerd.log")"
fi

if ! timeout 120 docker pull --quiet "$BASE" >/dev/null 2>&1; then
    echo "no registry is reached: the base image is made with debootstrap"
    BASE=tangram-try-base
    debootstrap --variant=minbase --include=ca-certificates,python3,python3-venv \
        bookworm "$WORK/base" >"$WORK/debootstrap.log" || fail "$(tail -n 3 "$WORK/debootstrap.log")"
    # A machine that reaches its registries by a certificate of its own shares it.
    cp /etc/ssl/certs/ca-certificates.crt "$WORK/base/etc/ssl/certs/"
    printf '[global]\ncert = /etc/ssl/certs/ca-certificates.crt\n' >"$WORK/base/etc/pip.conf"
    tar --directory "$WORK/base" --create . | docker import - "$BASE" >/dev/null
fi

# torch's CPU build, where this machine's pip offers one; else the images carry CUDA.
torch=$(sed -n 's/^torch==//p' ../constraints.txt)
if ! compgen -G "wheels/torch-*.whl" >/dev/null && python3 -m pip --version >/dev/null 2>&1; then
    OWN_WHEEL=$(python3 -m pip install --dry-run --ignore-installed --no-deps --quiet --report - "torch==$torch" 2>/dev/null |
        python3 -c 'import json, sys, urllib.parse as u; print(u.unquote(json.load(sys.stdin)["install"][0]["download_info"]["url"]).rpartition("/")[2])' || true)
    if [[ $OWN_WHEEL == *+cpu* ]]; then
        python3 -m pip download --quiet --no-deps --dest wheels "torch==$torch"
    else
        OWN_WHEEL=
    fi
fi

# ---- what is looked at ---------------------------------------------------------------------------
build() { docker build --file Dockerfile --build-arg "BASE=$BASE" --target "$1" --tag "tangram-$1" ..; }
metric() { curl --fail --silent "http://127.0.0.1:$METRICS_PORT/metrics" | sed -n "s/^tangram_$1 //p"; }
above() { local now; now=$(metric "$1") && [[ -n $now ]] && python3 -c "import sys; sys.exit(not $now > $2)"; }
equals() { local now; now=$(metric "$1") && [[ -n $now ]] && python3 -c "import sys; sys.exit(not $now == $2)"; }
master() { compose ps --quiet master; }
in_volume() { docker run --rm --volume tangram-try_runs:/runs --entrypoint python3 tangram-master-cpu -c "$1"; }
lacks() { ! docker run --rm --entrypoint python3 "$1" -c "import $2"; }
has() { docker run --rm --entrypoint python3 "$1" -c "import $2"; }
is_user() { [[ $(docker run --rm --entrypoint id "$1" --user) == 10001 ]]; }
healthy() { [[ $(docker inspect --format '{{.State.Health.Status}}' "$1") == healthy ]]; }
# The process under the container's init is killed: what `docker kill` ends is not started again.
kill_inside() { pkill --signal KILL --parent "$(docker inspect --format '{{.State.Pid}}' "$1")"; }
restarts() { (($(docker inspect --format '{{.RestartCount}}' "$1") >= $2)); }
rose() {  # the mean reward of the evaluations, by so much
    in_volume "
import json, sys
lines = [json.loads(line) for line in open('/runs/run/curve.jsonl')]
print(lines[0]['mean_reward'], lines[-1]['mean_reward'])
sys.exit(not lines[-1]['mean_reward'] > lines[0]['mean_reward'] + $1)"
}
saved() { in_volume "import glob, sys; sys.exit(not glob.glob('/runs/run/checkpoints/[0-9]*/manifest.json'))"; }

# ---- images --------------------------------------------------------------------------------------
held "docker-compose.yml is valid" compose config --quiet
held "the gpu profile is valid" env COMPOSE_PROFILES=gpu docker-compose config --quiet
for target in worker master-cpu test; do
    held "the image $target is built" build "$target"
done
held "the worker has no TensorBoard" lacks tangram-worker tensorboard
held "the worker has no CUDA" lacks tangram-worker triton
held "the worker has PyBullet" has tangram-worker pybullet
held "the master has no PyBullet" lacks tangram-master-cpu pybullet
held "the master has TensorBoard" has tangram-master-cpu tensorboard
for image in tangram-worker tangram-master-cpu; do
    held "$image does not run as root" is_user "$image"
done
held "the fast tests pass in the image test" docker run --rm tangram-test

# ---- a training ----------------------------------------------------------------------------------
held "up starts everything" compose up --detach --scale worker=2
held "the master is healthy" eventually healthy "$(master)"
held "two workers and an evaluator join" eventually equals players 2.0
held "the master learns" eventually above updates 20
held "the mean reward rises by 0.5" eventually rose 0.5
held "TensorBoard answers" eventually curl --fail --silent --output /dev/null "http://127.0.0.1:$TENSORBOARD_PORT"
worker=$(compose ps --quiet worker | sed -n 1p)  # head would end the one before it, and all this
held "a worker's container is healthy" eventually healthy "$worker"

kill_inside "$worker"
held "a worker that was killed is started again" eventually restarts "$worker" 1
held "and joins again" eventually equals players 2.0

updates=$(metric updates)
kill_inside "$(master)"
held "a master that was killed is started again" eventually restarts "$(master)" 1
held "and goes on from what it left" eventually above updates "$updates"
held "with its workers" eventually equals players 2.0

compose up --detach --scale worker=3 >/dev/null 2>&1
held "one more worker joins" eventually equals players 3.0
compose up --detach --scale worker=1 >/dev/null 2>&1
held "two of them leave" eventually equals players 1.0

updates=$(metric updates)
held "down ends everything" compose down --timeout 120
held "and leaves a checkpoint" saved
held "up again" compose up --detach
held "goes on from that checkpoint" eventually above updates "$updates"
held "down again" compose down --timeout 120

echo
echo "versions: docker $(docker version --format '{{.Server.Version}}'); $(docker-compose --version | head -n 1); $(sed -n 's/^PRETTY_NAME=//p' /etc/os-release)"
docker images --format '{{.Repository}}: {{.Size}}' | grep -E '^tangram-(worker|master-cpu|test|try-base)' || true
for image in tangram-worker tangram-master-cpu; do
    echo "largest parts of $image, MiB:"
    docker run --rm --entrypoint sh "$image" -c 'du --summarize --block-size=1M /opt/tangram/lib/python3*/site-packages/* | sort --numeric --reverse | head -n 6' |
        sed -E 's|/opt/.*site-packages/||; s/^/    /'
done
echo
trap - EXIT
clean_up
SAID=/dev/null
held "nothing is left behind" nothing_left
echo
if ((NOT_HELD)); then
    echo "$NOT_HELD did not hold"
    exit 1
fi
echo "everything held"
