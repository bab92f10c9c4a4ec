# A SLURM of two nodes on this one machine, in a folder of its own, for try.sh.
# shellcheck shell=bash
# shellcheck disable=SC2154 # work, PATIENCE_S and held are those of try.sh

daemons=()

install_slurm() {
    local -a lacking=()
    command -v slurmctld slurmd sbatch >/dev/null || lacking+=(slurm-wlm)
    command -v munged >/dev/null || lacking+=(munge)
    ((${#lacking[@]})) || return 0
    echo "installing ${lacking[*]}"
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends \
        "${lacking[@]}" >"$work/apt.log" 2>&1 || { tail "$work/apt.log"; return 1; }
    # The packages start services; the ones below are this script's own.
    if [[ -d /run/systemd/system ]]; then
        systemctl disable --now munge slurmctld slurmd >/dev/null 2>&1 || true
    fi
}

free_ports() {
    python3 - "$1" <<'END'
import socket, sys
taken = [socket.socket() for _ in range(int(sys.argv[1]))]
for one in taken:
    one.bind(("127.0.0.1", 0))
print(*(one.getsockname()[1] for one in taken))
END
}

# More CPUs than the machine has are promised (config_overrides): waiting costs little. The GPU is
# pretended. A requeued job waits for as long as a credential lives.
write_configuration() {
    local ports host
    host=$(hostname -s)
    read -ra ports <<<"$(free_ports 3)"
    cat >"$SLURM_CONF" <<END
ClusterName=try
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=${ports[0]}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket=$work/munge.socket,cred_expire=20
CredType=cred/munge
StateSaveLocation=$work/state
SlurmdSpoolDir=$work/spool.%n
SlurmctldPidFile=$work/slurmctld.pid
SlurmdPidFile=$work/slurmd.%n.pid
SlurmctldLogFile=$work/slurmctld.log
SlurmdLogFile=$work/slurmd.%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
SwitchType=switch/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
DefMemPerCPU=1000
SlurmdParameters=config_overrides
SchedulerParameters=bf_interval=5,sched_interval=5
ReturnToService=2
MinJobAge=3600
PlugStackConfig=/dev/null
GresTypes=gpu
NodeName=try1 NodeHostname=$host NodeAddr=127.0.0.1 Port=${ports[1]} CPUs=12 RealMemory=64000 Gres=gpu:1
NodeName=try2 NodeHostname=$host NodeAddr=127.0.0.1 Port=${ports[2]} CPUs=12 RealMemory=64000
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
END
    echo "NodeName=try1 Name=gpu File=/dev/null" >"$work/gres.conf"
}

start_cluster() {
    chmod 755 "$work" # munged insists on it; what is secret in it has modes of its own
    export SLURM_CONF=$work/slurm.conf
    write_configuration
    mkdir -p "$work/state" "$work/spool.try1" "$work/spool.try2"
    (umask 077 && head -c 1024 /dev/urandom >"$work/munge.key")
    munged --foreground --key-file="$work/munge.key" --socket="$work/munge.socket" \
        --pid-file="$work/munged.pid" --log-file="$work/munged.log" \
        --seed-file="$work/munged.seed" >"$work/munged.out" 2>&1 &
    daemons=("$!")
    until_true 30 test -S "$work/munge.socket"
    slurmctld -D >"$work/slurmctld.out" 2>&1 &
    daemons+=("$!")
    for node in try1 try2; do
        slurmd -D -N "$node" >"$work/slurmd.$node.out" 2>&1 &
        daemons+=("$!")
    done
    until_true 60 nodes_are_up
}

nodes_are_up() {
    [[ $(sinfo --noheader --Node --states=idle --format=%N 2>/dev/null | wc -l) == 2 ]]
}

# The daemons in the order that lets each say what it must; munged last.
stop_cluster() {
    ((${#daemons[@]})) || return 0
    scancel --user=root >/dev/null 2>&1 || true
    until_true 90 queue_is_empty || true
    until_true 60 steps_are_gone || true
    local i
    for ((i = ${#daemons[@]} - 1; i >= 1; i--)); do
        kill "${daemons[i]}" 2>/dev/null || true
        wait "${daemons[i]}" 2>/dev/null || true
    done
    kill "${daemons[0]}" 2>/dev/null || true
    wait "${daemons[0]}" 2>/dev/null || true
    daemons=()
    # Whatever is still there hangs.
    local process
    for process in $(left_processes); do
        kill -KILL "${process#/proc/}" 2>/dev/null || true
    done
}

# The daemons that keep the last steps' word must outlive them.
steps_are_gone() {
    local process
    for process in $(left_processes); do
        case $(cat "$process/comm" 2>/dev/null) in
            munged | slurmctld | slurmscriptd | slurmd | '') ;;
            *) return 1 ;;
        esac
    done
}

queue_is_empty() {
    [[ -z $(squeue --noheader 2>/dev/null) ]]
}

# Processes of the cluster and of its jobs: all of them inherit where its configuration is. What is
# started here to look for them must not.
left_processes() (
    unset SLURM_CONF
    grep -lzs "^SLURM_CONF=$work/slurm.conf" /proc/[0-9]*/environ | sed 's:/environ$::' || true
)

# Wait for a command to succeed: until_true SECONDS COMMAND...
until_true() {
    local until_s=$((SECONDS + $1))
    shift
    until "$@"; do
        ((SECONDS < until_s)) || return 1
        sleep 1
    done
}
