"""The parts of a run, made or restored, before anything moves."""

import socket
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

from master.arrivals import WelcomeInfo
from master.budget import Budget
from master.checkpointer import Restored, restore_run, warm_start
from master.config import MasterConfig
from master.divergence import DivergenceGuard
from master.health import OFF, Health
from master.hub import Hub
from master.journal import Journal, journal_run_id, read_journal
from master.keys import Keys, is_loopback, needs_keys, run_keys
from master.lockstep import Lockstep
from master.rundir import Record, RunFolder
from master.trainer import Trainer, choose_device
from tangram_agent.addresses import reachable, with_host
from tangram_agent.arrays import EpisodeSpec
from tangram_agent.config import ServiceConfig
from tangram_agent.setup import Setup

UNBOUNDED = (
    "warning: max_hours, max_episodes and max_updates are all 0: only Ctrl-C or SIGTERM ends this "
    "run, and learning rates do not decay"
)
PLAIN = (
    "warning: service.security=plain: whoever reaches this address can read what is sent, and send "
    "what he likes"
)


@dataclass(frozen=True, eq=False)
class Parts:
    """What a run consists of.

    Attributes:
        config: the master's settings.
        setup: the task and the agent.
        folder: where the run lies.
        trainer: learns.
        record: what the run has been through.
        budget: its bounds.
        hub: the sockets, open.
        guard: updates the trainer, and undoes what is not finite.
        journal: keeps what was not in the last checkpoint.
        lockstep: its rounds, None where nobody waits for anybody.
        health: HTTP for machines, None where it is off.
        keys: of the sockets, None where they are plain.
    """

    config: MasterConfig
    setup: Setup
    folder: RunFolder
    trainer: Trainer
    record: Record
    budget: Budget
    hub: Hub
    guard: DivergenceGuard
    journal: Journal
    lockstep: Lockstep | None = None
    health: Health | None = None
    keys: Keys | None = None

    @property
    def share(self) -> float:
        """The used share of the budget."""
        trainer = self.trainer
        return self.budget.share(self.record.loop_s, trainer.episodes, trainer.updates)

    def count(self, role: str) -> int:
        """Peers of a role that are connected."""
        return sum(peer.role == role for peer in self.hub.peers)

    def connection(self) -> dict[str, str]:
        """What a worker needs to find this master, and to be let in."""
        where = {
            "endpoint": self._announced(self.hub.endpoint),
            "weights_endpoint": self._announced(self.hub.weights_endpoint),
            "run_id": self.record.run_id,
        }
        if self.health is not None:
            where["http"] = reachable(self.health.url, self._host)
        if self.keys is None:
            return where
        return where | {
            "server_key": self.keys.server_public,
            "public_key": self.keys.worker_public,
            "secret_key": self.keys.worker_secret,
        }

    @property
    def _host(self) -> str:
        return self.config.service.host or socket.gethostname()

    def _announced(self, endpoint: str) -> str:
        named = bool(self.config.service.host)
        return with_host(endpoint, self._host) if named else reachable(endpoint, self._host)

    def close(self) -> None:
        """Close the sockets and the journal."""
        if self.health is not None:
            self.health.close()
        self.hub.close()
        self.journal.close()


def make_parts(
    config: MasterConfig,
    setup: Setup,
    folder: RunFolder,
    notice: Callable[[str], None],
    progress: Callable[[], None] = lambda: None,
) -> Parts:
    """Make everything, from the newest checkpoint where the run is to be resumed.

    Args:
        config: the master's settings.
        setup: the task and the agent.
        folder: prepared and locked.
        notice: takes lines for the user.
        progress: called while the journal is read, which may take long.

    Raises:
        TangramError: the port or a checkpoint cannot be used, or there is no such device.
    """
    service, resumes = config.service, config.resume == "auto"
    trainer = Trainer(setup, config.seed, choose_device(service.device), service.lag_updates)
    found = restore_run(folder.checkpoints, trainer, notice) if resumes else None
    if found is None and config.warm_start is not None:
        notice(warm_start(Path(config.warm_start), trainer))
    rest = found or Restored(_new_record(folder.journal), {})
    if not Budget(config).bounded:
        notice(UNBOUNDED)
    with ExitStack() as opened:  # closed again if what follows fails
        parts = _open(config, setup, folder, trainer, rest.record, opened, notice)
        if found:
            parts.hub.load_state(rest.hub)
        _insert_again(parts, rest.segment, notice, progress)
        opened.pop_all()
    if resumes:
        began = found or trainer.episodes
        notice(f"goes on after {trainer.updates:,} updates" if began else "a new run begins")
    return parts


def _open(
    config: MasterConfig,
    setup: Setup,
    folder: RunFolder,
    trainer: Trainer,
    record: Record,
    opened: ExitStack,
    notice: Callable[[str], None],
) -> Parts:
    """The parts around a trainer, with their sockets open."""
    service, spec, lockstep = config.service, EpisodeSpec.of(setup), Lockstep.of(config.service)
    keys = _keys(service, folder, notice)
    info = WelcomeInfo(
        run_id=record.run_id,
        seed=config.seed,
        fingerprints=setup.fingerprints(),
        spec=spec,
        window=service.window,
        lockstep=lockstep is not None,
    )
    place, patience_s = (service.bind, service.port), service.silence_seconds
    hub = opened.enter_context(Hub(*place, info, patience_s, keys, service.weights_port))
    health = None
    if service.http_port != OFF:
        health = opened.enter_context(closing(Health(service.http_bind, service.http_port)))
    return Parts(
        config=config,
        setup=setup,
        folder=folder,
        trainer=trainer,
        record=record,
        budget=Budget(config),
        hub=hub,
        guard=DivergenceGuard(trainer, service.max_bad_updates, folder.bad_batch),
        journal=Journal(
            folder.journal, record.run_id, setup.task_digest(), service.journal_sync_seconds
        ),
        lockstep=lockstep,
        health=health,
        keys=keys,
    )


def _keys(service: ServiceConfig, folder: RunFolder, notice: Callable[[str], None]) -> Keys | None:
    """Keys where the sockets must be encrypted."""
    if needs_keys(service.bind, service.security):
        return run_keys(folder.keys)
    if not is_loopback(service.bind):
        notice(PLAIN)
    return None


def _new_record(journal: Path) -> Record:
    """Of the run whose journal it is, which was killed before its first checkpoint, or of none."""
    run_id = journal_run_id(journal)
    return Record() if run_id is None else Record(run_id)


def _insert_again(
    parts: Parts, segment: int, notice: Callable[[str], None], progress: Callable[[], None]
) -> None:
    """Take in what was acknowledged after the checkpoint."""
    found = read_journal(
        parts.folder.journal,
        segment,
        parts.record.run_id,
        parts.setup.task_digest(),
        EpisodeSpec.of(parts.setup),
        notice,
    )
    before = parts.trainer.episodes
    for arrival in found:
        progress()
        if parts.hub.recover(arrival):
            _learn_first(parts, progress)
            parts.trainer.insert(arrival.episodes)
    if parts.trainer.episodes > before:
        notice(f"{parts.trainer.episodes - before:,} episodes come back from the journal")


def _learn_first(parts: Parts, progress: Callable[[], None]) -> None:
    """In lockstep a round begins when the updates of those before it are made."""
    trainer, lockstep = parts.trainer, parts.lockstep
    if lockstep is None or not lockstep.begins_round(trainer.episodes):
        return
    while trainer.rate_limiter.may_update() and not parts.budget.spent(0.0, trainer.updates):
        progress()
        parts.guard.update(parts.share)
