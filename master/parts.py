"""The parts of a run, made or restored, before anything moves."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from master.arrivals import WelcomeInfo
from master.budget import Budget
from master.checkpoint import restore_run, warm_start
from master.config import MasterConfig
from master.hub import Hub
from master.record import Record
from master.rundir import RunFolder
from master.trainer import Trainer, choose_device
from tangram_agent.payloads import EpisodeSpec
from tangram_agent.setup import Setup

UNBOUNDED = (
    "warning: max_hours, max_episodes and max_updates are all 0: only Ctrl-C or SIGTERM ends this "
    "run, and learning rates do not decay"
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
    """

    config: MasterConfig
    setup: Setup
    folder: RunFolder
    trainer: Trainer
    record: Record
    budget: Budget
    hub: Hub

    @property
    def share(self) -> float:
        """The used share of the budget."""
        trainer = self.trainer
        return self.budget.share(self.record.loop_s, trainer.episodes, trainer.updates)

    def count(self, role: str) -> int:
        """Peers of a role that are connected."""
        return sum(peer.role == role for peer in self.hub.peers)

    def connection(self) -> dict[str, str]:
        """What a worker needs to find this master."""
        return {
            "endpoint": self.hub.endpoint,
            "weights_endpoint": self.hub.weights_endpoint,
            "run_id": self.record.run_id,
        }

    def close(self) -> None:
        """Close the sockets."""
        self.hub.close()


def make_parts(
    config: MasterConfig, setup: Setup, folder: RunFolder, notice: Callable[[str], None]
) -> Parts:
    """Make everything, from the newest checkpoint where the run is to be resumed.

    Args:
        config: the master's settings.
        setup: the task and the agent.
        folder: prepared and locked.
        notice: takes lines for the user.

    Raises:
        TangramError: the port or a checkpoint cannot be used, or there is no such device.
    """
    service = config.service
    trainer = Trainer(setup, config.seed, choose_device(service.device), service.lag_updates)
    found = restore_run(folder.checkpoints, trainer, notice) if config.resume == "auto" else None
    if found is None and config.warm_start is not None:
        notice(warm_start(Path(config.warm_start), trainer))
    record, table = found or (Record(), {})
    budget = Budget(config)
    if not budget.bounded:
        notice(UNBOUNDED)
    if config.resume == "auto":
        notice(f"goes on after {trainer.updates:,} updates" if found else "a new run begins")
    info = WelcomeInfo(
        run_id=record.run_id,
        seed=config.seed,
        fingerprints=setup.fingerprints(),
        spec=EpisodeSpec.of(setup),
        window=service.window,
    )
    hub = Hub(service.bind, service.port, info)
    if found:
        hub.load_state(table)
    return Parts(config, setup, folder, trainer, record, budget, hub)
