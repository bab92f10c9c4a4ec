# The parts of try.sh: what is submitted, and what must then be seen.
# shellcheck shell=bash
# shellcheck disable=SC2154 # work, PATIENCE_S and held are those of try.sh

# A training that shows that it learns, though it is short.
TINY=(service.eval_seconds=3 service.eval_episodes=50)

# A job script: submit RUN_DIR [OPTION OF SBATCH...] SCRIPT [SETTING...]
submit() {
    RUN_DIR=$1 sbatch --parsable --output="$work/%x-%j.log" "${@:2}"
}

job_field() { # JOB NAME
    scontrol show job "$1" 2>/dev/null | grep -oE "(^| )$2=[^ ]*" | sed -n 1p | cut -d= -f2
}

has_ended() { # JOB
    [[ $(job_field "$1" JobState) =~ ^(COMPLETED|FAILED|CANCELLED|TIMEOUT|NODE_FAIL|)$ ]]
}

await_end() { # JOB...
    local job
    for job in "$@"; do
        until_true "$PATIENCE_S" has_ended "$job" || echo "job $job has not ended"
    done
}

was_requeued() { # JOB
    (($(job_field "$1" Restarts) > 0))
}

step_of() { # JOB NAME: the id of its step that is called so
    squeue --noheader --steps --jobs="$1" --format='%i %j' | awk -v name="$2" '$2 == name {print $1}'
}

result_is() { # RUN_DIR PATTERN: how the run ended
    grep -Eq "\"ended_by\": \"$2" "$1/result.json" 2>/dev/null
}

evaluations() { # RUN_DIR COUNT
    [[ -e $1/curve.jsonl ]] && (($(wc -l <"$1/curve.jsonl") >= $2))
}

# How far the run is, and what it scores, at its first and its newest evaluation.
curve_of() { # RUN_DIR
    python3 - "$1/curve.jsonl" <<'END'
import json, sys
try:
    rows = [json.loads(line) for line in open(sys.argv[1])]
except OSError:
    rows = []
rows = rows or [{"updates": -1, "mean_reward": 0.0}]
print(rows[0]["updates"], rows[-1]["updates"], rows[0]["mean_reward"], rows[-1]["mean_reward"])
END
}

reward_rose() { # RUN_DIR LEAST
    local first last begun now
    read -r first last begun now <<<"$(curve_of "$1")"
    printf '  mean reward %.3f after %d updates, %.3f after %d\n' "$begun" "$first" "$now" "$last"
    awk -v begun="$begun" -v now="$now" -v least="$2" 'BEGIN {exit !(now - begun >= least)}'
}

was_cancelled() { # RUN_DIR NAME: a worker's log has the word of SLURM, or of itself
    grep -qsE 'CANCELLED|ends: SIGTERM' "$1"/logs/"$2".*.log
}

nodes_of() { # JOB: of each of its components
    scontrol show job "$1" | sed -nE 's/^ +NodeList=([^ ]*).*/\1/p' | paste -sd ' '
}

joined() { # RUN_DIR: the runs that its workers joined, each once
    grep -ohE 'joined run [0-9a-f]+' "$1"/logs/*.log | sort -u
}

apart() { # RUN_DIR OTHER: workers of each joined one run, and not the same
    [[ $(joined "$1" | wc -l) == 1 && $(joined "$2" | wc -l) == 1 && $(joined "$1") != $(joined "$2") ]]
}

# Stands for an image: tells of the commands that it is put in front of.
make_front() {
    cat >"$work/front" <<END
#!/bin/sh
echo "\$1" >>"$work/front.log"
exec "\$@"
END
    chmod +x "$work/front"
}

front_saw() { # the commands in order, each once
    [[ $(sort -u "$work/front.log" | paste -sd ' ') == "$*" ]]
}

# Two runs on one node; one loses a worker, the other has something in front of its commands.
try_node() {
    local a=$work/a b=$work/b first second step
    make_front
    first=$(submit "$a" --nodelist=try1 --ntasks=4 slurm/train.sbatch max_updates=600 "${TINY[@]}")
    second=$(RUN_WITH=$work/front submit "$b" --nodelist=try1 --ntasks=3 slurm/train.sbatch \
        max_updates=600 seed=1 sim=kinematic "${TINY[@]}")
    until_true "$PATIENCE_S" evaluations "$a" 2 || true
    step=$(step_of "$first" worker-1)
    scancel "$step" || true
    held "train.sbatch: a worker's step was cancelled" \
        until_true 60 was_cancelled "$a" worker-1
    await_end "$first" "$second"
    held "train.sbatch, PyBullet: the run went on to its bound" result_is "$a" max_updates=600
    held "train.sbatch, PyBullet: the reward rose" reward_rose "$a" 0.3
    held "train.sbatch, kinematic: a second run on the same node reached its bound, too" \
        result_is "$b" max_updates=600
    held "train.sbatch, kinematic: the reward rose" reward_rose "$b" 0.3
    held "train.sbatch: RUN_WITH stood in front of each command" \
        front_saw tangram-master tangram-worker
    held "two runs on one node: no worker joined the other's" apart "$a" "$b"
    held "a run that reached its bound was not queued again" \
        test "$(job_field "$first" Restarts)$(job_field "$second" Restarts)" = 00
    held "its job is complete" test "$(job_field "$first" JobState)" = COMPLETED
}

# A time limit that cuts a run of each kind.
try_limit() {
    local a=$work/limit h=$work/het e=$work/elastic job het master workers
    local -a settings=(sim=kinematic max_updates=0 max_hours=0.06 "${TINY[@]}")
    local -a short=(--time=5 --signal=B:USR1@120)
    job=$(submit "$a" "${short[@]}" --nodes=2 --ntasks=3 slurm/train.sbatch "${settings[@]}")
    het=$(submit "$h" "${short[@]}" --cpus-per-task=1 : --time=5 --ntasks=2 slurm/hetjob.sbatch \
        "${settings[@]}")
    read -r master workers <<<"$(
        RUN_DIR=$e WORKERS=2 MASTER_OPTIONS="${short[*]} --output=$work/%x-%j.log" \
            WORKER_OPTIONS="--time=5 --signal=B:USR1@60 --output=$work/%x-%A_%a.log" slurm/elastic/submit.sh "${settings[@]}" |
            sed -nE 's/^master: job ([0-9]+),.* workers: job ([0-9]+),.*/\1 \2/p'
    )"
    until_true "$PATIENCE_S" evaluations "$e" 2 || true
    scancel "${workers}_2"
    local seen
    read -r _ seen _ _ <<<"$(curve_of "$e")"
    held "elastic: array task 2 was cancelled" until_true 60 was_cancelled "$e" task-2
    held "elastic: the run goes on without it" until_true "$PATIENCE_S" is_beyond "$e" "$seen"
    cut_and_resumed train.sbatch "$job" "$a"
    cut_and_resumed hetjob.sbatch "$het" "$h"
    cut_and_resumed elastic "$master" "$e"
    await_end "$job" "$het" "$master"
    for name in "$a" "$h" "$e"; do
        held "${name##*/}: the run went on to its bound" result_is "$name" max_hours=0.06
        held "${name##*/}: the reward rose" reward_rose "$name" 0.3
        held "${name##*/}: updates went on from the checkpoint" went_on "$name"
    done
    held "train.sbatch: on two nodes" test "$(nodes_of "$job")" = 'try[1-2]'
    held "hetjob.sbatch: the master on the node with the GPU, the workers on the other" \
        test "$(nodes_of "$het")" = 'try1 try2'
    held "between nodes everything was encrypted" \
        test -s "$a/keys.json" -a -s "$h/keys.json" -a -s "$e/keys.json"
    held "elastic: at its own time limit a worker left and was queued again" \
        was_requeued "${workers}_1"
    held "elastic: a worker came back to the master's next life" came_back "$e"
    held "elastic: evaluator and workers left when the run was complete" \
        until_true 120 none_queued "$workers"
}

is_beyond() { # RUN_DIR UPDATES
    local last
    read -r _ last _ _ <<<"$(curve_of "$1")"
    ((last > $2))
}

# The limit struck and the job was queued again; its next life gets the time that it needs.
cut_and_resumed() { # NAME JOB RUN_DIR
    held "$1: near the time limit the job was queued again" \
        until_true "$PATIENCE_S" was_requeued "$2"
    held "$1: its master had ended with a checkpoint" result_is_before "$3"
    scontrol update "JobId=$2" TimeLimit=30
}

result_is_before() { # RUN_DIR: in this life, or set aside by the next
    result_is "$1" SIGUSR1 || grep -q '"ended_by": "SIGUSR1"' "$1/result.before.json"
}

# The second life said how many updates it begins with; they are those that the first ended with.
went_on() { # RUN_DIR
    local at before
    at=$(grep -ohE 'goes on after [0-9,]+ updates' "$1"/logs/master.*.log | tail -n 1 | tr -dc 0-9)
    before=$(grep -oE '"updates": [0-9]+' "$1/result.before.json" | tr -dc 0-9)
    echo "  the checkpoint held $before updates, the next life began with ${at:-none}"
    [[ -n $at && $at -gt 0 && $at == "$before" ]] && is_beyond "$1" "$at"
}

came_back() { # RUN_DIR: it saw a master end, and joined again
    grep -c 'joined run' <(sed -n '/waits for the next one/,$p' "$1"/logs/task-[01].*.log) >/dev/null
}

none_queued() { # JOB
    [[ -z $(squeue --noheader --jobs="$1" 2>/dev/null) ]]
}

report() { # RUNS
    .venv/bin/tangram-report runs="$1" out="$work/report" >/dev/null
}

# Seeds as jobs and one table of them; a public task; a task and an agent in files of one's own.
try_tasks() {
    local out=$work/seeds gym=$work/gym own=$work/own seed
    local -a jobs=() short=(max_updates=40 agent.learning_starts=64 "${TINY[@]}")
    for seed in 0 1 2; do
        jobs+=("$(submit "$out/$seed" --ntasks=3 slurm/train.sbatch seed="$seed" sim=kinematic "${short[@]}")")
    done
    jobs+=("$(submit "$gym" --ntasks=3 slurm/train.sbatch task=gym task.id=FetchPush-v4 \
        'task.imports=[gymnasium_robotics]' max_updates=40 "${TINY[@]}")")
    jobs+=("$(submit "$own" --ntasks=3 slurm/train.sbatch task=docs/examples/point.py:Point \
        agent=docs/examples/td3.py:TD3 max_updates=40 "${TINY[@]}")")
    await_end "${jobs[@]}"
    held "three jobs of three seeds reached their bound" \
        test "$(grep -l '"ended_by": "max_updates=40"' "$out"/*/result.json | wc -l)" = 3
    held "tangram-report made one table of them" report "$out"
    grep -E '^\| (training|.* 3 of 3) ' "$work/report/tables.md" | sed 's/^/  /' || true
    held "three seeds stand there" \
        test "$(grep -cE '^\| .*\| 3 of 3 \|' "$work/report/tables.md")" = 1
    held "task=gym task.id=FetchPush-v4: the run reached its bound" result_is "$gym" max_updates=40
    held "a task and an agent of one's own: the run reached its bound" result_is "$own" max_updates=40
}
