"""Attacks on the folder, disk and processes of a training, and on a lockstep training."""

import os
import time
from pathlib import Path
from threading import Timer

import psutil

from master.record.journal import segments
from tangram_core.run.code import override
from tangram_core.wire.messages import EpisodeBatch
from tangram_core.wire.schema import MAX_COUNT
from tangram_lab.benchmarks.trials.chaos import WORKERS, Witness, compare
from tangram_lab.benchmarks.trials.intruder import NOBODY, knock
from tangram_lab.benchmarks.trials.starts import STARTS
from tangram_lab.benchmarks.trials.target import (
    ENDS_S,
    OFTEN,
    OURS,
    Attack,
    Rows,
    Seen,
    Target,
    episodes_of,
    one_line,
    training,
    tried,
    until,
)
from worker.talk.client import Client

LEARNS_LITTLE = "agent.updates_per_transition=0.1"  # the score of this training is not used
SILENCE = "service.silence_seconds=6"
BUSY_PERCENT = 20.0  # of a core: an evaluator at work; it sleeps between evaluations
ODD_NAME = "a=run \\of \"ü'"


def sockets_of_others(target: Target) -> Seen:
    place = Path(target.where["endpoint"].removeprefix("ipc://"))
    private = place.is_socket() and not place.parent.stat().st_mode & 0o077
    stranger = knock(target.where["endpoint"], [target.hello(index=0)], NOBODY)
    stranger.join(10.0)
    answers = stranger.exitcode if os.geteuid() == 0 else 0
    return private and answers == 0, f"{place.parent}: private {private}, {answers} answers"


def second_master(target: Target) -> Seen:
    arguments = (override("run_dir", str(target.folder)), "resume=auto", *OURS[1:])
    held, seen = one_line("master", *arguments, cwd=target.folder.parent)
    return held and "in use" in seen and target.goes_on(), seen


def killed(target: Target) -> bool:
    """Kill the master while batches are only in the journal; True if the training goes on.

    Its settings are deleted just before.
    """
    target.checkpoint()
    target.goes_on(20.0)
    master = target.master
    (target.folder / "config.yaml").unlink()
    master.kill()
    return until(lambda: target.master.pid != master.pid and target.goes_on(10.0))


def killed_after_huge_numbers(target: Target) -> Seen:
    """Send a batch with the largest numbers, so journal and checkpoint contain them; then kill."""
    setup = target.setup
    batch = EpisodeBatch(1, 0, episodes_of(setup, 1)).encode(setup.spec)
    for huge in (2**63 - 1, MAX_COUNT):
        target.ask(target.hello(incarnation=huge), batch)
        target.ask(target.hello(incarnation=1, first=huge, index=3001, process="other"))
    held = killed(target)
    return held, "it goes on" if held else "it does not come back"


def killed_after_unlink(target: Target) -> Seen:
    """Delete the journal just after a checkpoint, then kill the master before the next one."""
    journal = target.folder / "journal"
    target.checkpoint()
    for path in segments(journal).values():
        path.unlink(missing_ok=True)
    target.goes_on(20.0)
    told, held = "has lost its newest segment" in target.told(), killed(target)
    return told and held, f"told: {told}; killed after a checkpoint, it goes on: {held}"


def folder_away(target: Target) -> Seen:
    target.goes_on()
    away = target.folder.with_name("away")
    target.folder.rename(away)
    time.sleep(3.0)
    stopped = not target.folder.exists()
    if stopped:
        away.rename(target.folder)
    held, told = stopped and target.goes_on(10.0), f"{target.folder.name} is gone" in target.told()
    seen = f"made again by accident: {not stopped}; told: {told}; goes on when it is back: {held}"
    return held and told, seen


def full_disk(target: Target) -> Seen:
    master = target.master
    before = master.rlimit(psutil.RLIMIT_FSIZE)
    master.rlimit(psutil.RLIMIT_FSIZE, (1, before[1]))  # log lines find no room, either
    until_s, taken, stands = time.monotonic() + 15.0, -1.0, False
    while not stands and time.monotonic() < until_s:
        stands, taken = target.numbers()["episodes"] == taken, target.numbers()["episodes"]
        time.sleep(3.0)
    master.rlimit(psutil.RLIMIT_FSIZE, before)
    held = target.goes_on(10.0) and target.master.pid == master.pid
    told = "batches are taken in" in target.told()
    return stands and held, f"it pauses: {stands}; with room again it goes on: {held}; told: {told}"


def frozen(target: Target) -> Seen:
    master = target.master
    master.suspend()
    time.sleep(8.0)
    master.resume()
    held = target.goes_on(10.0) and target.master.pid == master.pid
    return held, "it goes on" if held else "it does not go on"


def asleep(target: Target) -> Seen:
    """Suspend a worker until the master forgets it, as when a laptop sleeps; then resume it."""
    worker = target.process("role=player")
    worker.suspend()
    fewer = until(lambda: target.numbers()["players"] < WORKERS + 1)
    worker.resume()
    held = until(lambda: target.numbers()["players"] == WORKERS + 1)
    return fewer and held, f"forgotten: {fewer}; takes part again: {held}"


def without_evaluator(target: Target) -> Seen:
    """Kill the evaluator during an evaluation, and check that scores go on."""
    one = target.process("role=evaluator")
    until(lambda: one.cpu_percent(0.5) > BUSY_PERCENT)
    one.kill()
    held = target.goes_on(2.0, "hub/scores")
    return held, f"scores go on: {held}"


OWN: list[Attack] = [
    ("5", "another user at the sockets", "1", sockets_of_others),
    ("held", "two masters on one folder", "1", second_master),
    ("2", "the largest numbers, then kill -9", "1 kill", killed_after_huge_numbers),
    ("8", "the journal unlinked, then kill -9", "1 kill", killed_after_unlink),
    ("8", "the run folder taken away", "3 s", folder_away),
    ("held", "a full disk", "until it pauses", full_disk),
    ("held", "SIGSTOP", "8 s", frozen),
    ("held", "a worker that sleeps until it is forgotten", "1", asleep),
    ("held", "the evaluator killed in mid-score", "1", without_evaluator),
]


def wrong_batch_in_lockstep(target: Target) -> Seen:
    setup = target.setup
    spec, rounds = setup.spec, 0
    with Client(str(target.folder), "player", 0, setup.fingerprints(), spec) as client:
        late = Timer(20.0, client.stop, ["it takes too long"])
        late.start()
        client.join()
        order = client.wait_for_order(None)
        if order is not None and client.send(episodes_of(setup, 2), order.version):
            while rounds < 3 and (order := client.wait_for_order(order)) is not None:
                client.send(episodes_of(setup, order.episodes), order.version)
                rounds += 1
        late.cancel()
    return rounds == 3, f"{rounds} of 3 rounds after it"


LOCKSTEP: list[Attack] = [("6", "another batch than was ordered", "1", wrong_batch_in_lockstep)]


def harmed(folder: Path) -> Rows:
    """Run the attacks that need trainings of their own in `folder`; return their rows."""
    rows = [*witnessed(folder / ODD_NAME), *tried(STARTS, folder)]
    lockstep = ("service.mode=lockstep", "workers=1", "max_updates=0", "sim=kinematic")
    with training(folder / "lockstep", *lockstep, name="master") as target:
        return [*rows, *tried(LOCKSTEP, target)]


def witnessed(folder: Path) -> Rows:
    """Run the attacks of OWN on one training, with a `Witness` that checks the delivery."""
    with training(folder, "max_updates=0", *OURS, LEARNS_LITTLE, OFTEN, SILENCE) as target:
        witness, rows = Witness(str(folder), target.setup), Rows()
        witness.start()
        target.goes_on(100.0)
        after = 0  # attacks after which batches were acknowledged again
        for attack in OWN:
            rows += tried([attack], target)
            after += acknowledged_again(witness)
        witness.stop()
        witness.join(ENDS_S)
    counts = compare(folder, witness)
    held = not (counts["lost"] or counts["doubled"] or witness.error) and after == len(OWN)
    seen = ", ".join(f"{n} {counts[n]:,}" for n in ("acknowledged", "lost", "doubled"))
    seen += f"; acknowledged again after {after} of {len(OWN)}"
    what = "held: kill -9 with a witness, in an odd folder"
    return [*rows, {"attack": what, "tried": "2 kills", "held": held, "seen": seen}]


def acknowledged_again(witness: Witness) -> bool:
    """Whether more batches of a witness are acknowledged after this call."""
    before = witness.acknowledged
    until(lambda: witness.acknowledged > before or not witness.is_alive(), ENDS_S)
    return witness.acknowledged > before
