"""One run of the master: create or restore all objects of the run, then start the loop."""

import logging
import secrets
import socket
import sys
from collections.abc import Iterable, Mapping
from contextlib import ExitStack, closing
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch

from master.checkpointer import Checkpointer, Restored, restore_run, warm_start
from master.config import MasterConfig
from master.hub.admission import WelcomeInfo
from master.hub.gate import Room
from master.hub.hub import Hub
from master.hub.security import Keys, listening_place, needs_keys, run_keys, write_keys
from master.learn.budget import Budget
from master.learn.divergence import DivergenceGuard
from master.learn.lockstep import Lockstep
from master.learn.trainer import Trainer, choose_device
from master.loop import Loop
from master.record.audit import Audit
from master.record.delivery import EpisodesArrived
from master.record.journal import Journal, Place
from master.record.recovery import Reader, journal_run_id
from master.record.resumable import check_resumable
from master.record.rundir import Claim, Clock, Record, RunFolder
from master.signals import StopSignals
from master.watch.console import Progress, logging_to, make_progress, sturdy_console
from master.watch.health import OFF, Health
from master.watch.metrics import Metrics
from master.watch.report import Reporter, StatusCollector
from master.watch.result import command_line, go_on_command, make_result, show_finished, show_result
from tangram_core.run.code import code_of
from tangram_core.run.process import WATCHDOG_S, Watchdog, keep_memory, watch_parent
from tangram_core.run.service import ServiceConfig
from tangram_core.setup import Setup
from tangram_core.wire.addresses import LOCAL, dns_error, reachable, with_host
from tangram_core.wire.messages import OPEN, WINDOW

# Time to end cleanly after the parent has died; a large replay buffer takes seconds to write.
GRACE_S = 30.0
UNBOUNDED = (
    "max_hours, max_episodes and max_updates are all 0: only Ctrl-C or SIGTERM ends this run, and "
    "learning rates do not decay"
)

log = logging.getLogger(__name__)


def run_master(config: MasterConfig, setup: Setup, resolved: Mapping[str, Any]) -> int:
    """Learn until a bound is reached or a signal comes, then write the result to the run folder.

    Args:
        config: the master's settings.
        setup: the task and the agent.
        resolved: the whole config as plain values, for config.yaml.

    Returns:
        Exit status 0, also after SIGINT and SIGTERM.

    Raises:
        TangramError: the folder, the port or a checkpoint cannot be used, or the weights are no
            longer finite.
    """
    form = config.service.log_format
    console = sturdy_console(sys.stdout)
    with ExitStack() as opened:
        opened.enter_context(logging_to(console, form))
        # tangram-train shares the terminal with this process, so its lines are shown here.
        launched = watch_parent(partial(log.info, "%s", extra={"event": "launcher"}), GRACE_S)
        Room.here()  # may refuse the run: before any file is written
        folder = RunFolder(config.run_dir)
        folder.prepare(config.resume)
        claim = opened.enter_context(folder.lock())
        signals = opened.enter_context(StopSignals())
        watchdog = opened.enter_context(Watchdog(WATCHDOG_S))
        code, evaluator = code_of(resolved), ""
        join = {"connect": folder.path, **code}
        if not launched:  # else tangram-train did this, with its own settings
            check_resumable(folder, resolved)
            listening_place(config.service.bind, folder.path)
            if folder.has_finished(config):
                show_finished(folder, form, code)
                return 0
            folder.write_config(resolved)
            evaluator = command_line("tangram-worker", {**join, "role": "evaluator"})
        go_on = go_on_command(folder, launched)
        progress = make_progress(console, f"tangram · {folder.path.name}", form, evaluator)
        opened.enter_context(closing(progress))
        loop, connection = open_run(config, setup, claim, progress, signals, watchdog, opened)
        loop.reporter.metrics.settings(resolved)
        folder.write_connection(connection)
        if not launched:
            log.info("workers join with: %s", command_line("tangram-worker", join))
            log.info("an evaluator, which scores the weights, joins with: %s", evaluator)
        reason = loop.run()
        facts, scores = loop.guard.trainer.facts(), setup.task.scores
        result = make_result(loop.finish(launched), scores, facts, config.seed, reason)
        folder.write_result(result)
        loop.reporter.metrics.hyperparameters(result, facts)
        loop.dismiss(f"the run has ended ({reason})")
        if form == "json":
            log.info("the run has ended (%s)", reason, extra={"event": "result", **result})
    if form != "json":
        show_result(console, folder, result, code, go_on)
    return 0


def open_run(
    config: MasterConfig,
    setup: Setup,
    claim: Claim,
    progress: Progress,
    signals: StopSignals,
    watchdog: Watchdog,
    opened: ExitStack,
) -> tuple[Loop, dict[str, Any]]:
    """Create all objects of a run; with resume=auto, restore them from the newest checkpoint.

    The journal may take long to read; the watchdog gets a sign of progress for each batch. `opened`
    closes the objects that are opened here.

    Returns:
        The loop, and the connection data for workers, see `connection_of`.

    Raises:
        TangramError: the port or a checkpoint cannot be used, or there is no such device.
    """
    service, folder = config.service, claim.run
    trainer, found = _make_trainer(config, setup, folder, watchdog)
    # A run that was killed before its first checkpoint has only a journal.
    rest = found or Restored(Record(journal_run_id(folder.journal) or secrets.token_hex(8)), {})
    run_id = rest.record.run_id
    guard = DivergenceGuard(trainer, folder.bad_batch)
    clock, budget = Clock(rest.record), Budget(config, trainer, rest.record)
    lockstep = Lockstep.of(service, config.workers, setup.spec)
    if not budget.bounded:
        log.warning(UNBOUNDED)
    keys = _keys(service, folder)
    hub = opened.enter_context(_open_hub(config, setup, run_id, keys))
    if keys is not None:
        folder.again[folder.keys] = lambda: write_keys(folder.keys, hub.keys or keys)
    health = None
    if service.http_port != OFF:
        health = opened.enter_context(closing(Health(service.http_bind, service.http_port)))
    if found is not None:
        hub.load_state(rest.hub)
    # Batches that were acknowledged after the checkpoint.
    digest, spec = setup.task_digest(), setup.spec
    batches = Reader(folder.journal, rest.place, run_id, digest, spec, log.warning)
    _insert_again(batches, hub, guard, budget, lockstep, watchdog)
    after = Place((rest.place or Place()).segment, batches.number)
    sync_s = service.journal_sync_seconds
    journal = Journal(folder.journal, run_id, digest, sync_s, after, batches.torn)
    opened.enter_context(closing(journal))
    if config.resume == "auto" and (found or trainer.episodes):
        log.info("goes on after %s updates", f"{trainer.updates:,}")
    elif config.resume == "auto":
        log.info("a new run begins")
    checkpointer = Checkpointer(service, claim, guard, hub, journal, clock)
    metrics = Metrics(folder.tensorboard, folder.curve, trainer.updates, rest.record.loop_s)
    opened.enter_context(closing(metrics))
    status = StatusCollector(folder.path.name, guard, hub, budget, clock, checkpointer)
    listeners = [hub.tell, *([] if health is None else [health.update])]
    reporter = Reporter(trainer, rest.record, status, progress, metrics, listeners, folder.picture)
    loop = Loop(
        service=service,
        folder=folder,
        hub=hub,
        guard=guard,
        lockstep=lockstep,
        budget=budget,
        clock=clock,
        checkpointer=checkpointer,
        reporter=reporter,
        signals=signals,
        watchdog=watchdog,
    )
    opened.enter_context(closing(loop))
    http = None if health is None else health.url
    return loop, connection_of(service, hub, run_id, http, keys)


def connection_of(
    service: ServiceConfig, hub: Hub, run_id: str, http: str | None, keys: Keys | None
) -> dict[str, Any]:
    """Connection data for workers: addresses, run id, and the keys if the run has any."""
    host = service.host or socket.gethostname()
    announced = with_host if service.host else reachable
    if service.host and (unknown := dns_error(with_host(hub.endpoint, host))):
        log.warning("service.host cannot be resolved here (%s); workers must be able to", unknown)
    where: dict[str, Any] = {
        "endpoint": announced(hub.endpoint, host),
        "weights_endpoint": announced(hub.weights_endpoint, host),
        "run_id": run_id,
        "machine": socket.gethostname(),
    }
    if http is not None:
        where["http"] = reachable(http, host)
    if keys is None:
        return where
    own = {role: asdict(pair) for role, pair in keys.own().items()}
    return where | {"server_key": keys.server.public, "keys": own}


def _open_hub(config: MasterConfig, setup: Setup, run_id: str, keys: Keys | None) -> Hub:
    service = config.service
    info = WelcomeInfo(
        run_id=run_id,
        seed=config.seed,
        fingerprints=setup.fingerprints(),
        spec=setup.spec,
        scores=frozenset(score.name for score in setup.task.scores),
        window=WINDOW,
        lockstep=service.mode == "lockstep",
    )
    bind = listening_place(service.bind, Path(config.run_dir))
    patience_s, audit = service.silence_seconds, Audit(RunFolder(config.run_dir).audit)
    return Hub(bind, service.port, info, patience_s, keys, Room.here(), audit)


def _keys(service: ServiceConfig, folder: RunFolder) -> Keys | None:
    """The keys of the run; None, with a warning if need be, if the sockets are not encrypted."""
    if needs_keys(service):
        return run_keys(folder.keys)
    if service.bind != LOCAL:
        log.warning("%s can read what is sent, and send anything", OPEN)
    return None


def _make_trainer(
    config: MasterConfig, setup: Setup, folder: RunFolder, watchdog: Watchdog
) -> tuple[Trainer, Restored | None]:
    """The trainer, restored from the newest checkpoint or warm-started if the settings say so."""
    service = config.service
    torch.set_num_threads(service.threads)
    keep_memory()
    device = choose_device(service.device)
    trainer = Trainer(setup, config.seed, device, compiled=service.compile)
    found = restore_run(folder.checkpoints, trainer) if config.resume == "auto" else None
    if found is None:
        folder.check_never_kept()
        if config.warm_start is not None:
            warm_start(Path(config.warm_start), trainer)
    if service.compile:
        log.info("compiling the update: the first time takes minutes, later times seconds")
    with watchdog.patient():
        trainer.learner.prepare()
    return trainer, found


def _insert_again(
    batches: Iterable[EpisodesArrived],
    hub: Hub,
    guard: DivergenceGuard,
    budget: Budget,
    lockstep: Lockstep | None,
    watchdog: Watchdog,
) -> None:
    """Insert the batches of the journal that are not in the checkpoint."""
    trainer, before = guard.trainer, guard.trainer.episodes
    for batch in batches:
        watchdog.progress()
        if not hub.recover(batch):
            continue
        # In lockstep, all updates of the rounds before come first.
        if lockstep is not None and lockstep.begins_round(trainer.episodes):
            while trainer.rate_limiter.may_update() and not budget.updates_spent():
                watchdog.progress()
                guard.update(budget.share)
        trainer.insert(batch.episodes)
    hub.recovered()
    if trainer.episodes > before:
        log.info("%s episodes restored from the journal", f"{trainer.episodes - before:,}")
