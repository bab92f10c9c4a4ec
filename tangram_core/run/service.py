"""How the processes of a run work together."""

from dataclasses import dataclass

from tangram_core.run.process import FORMATS
from tangram_core.settings import Settings, setting
from tangram_core.wire.addresses import LOCAL, check_host

MOST_ENVS, STEPS = 16, 128  # of service.envs=0: environments, and steps in all their episodes
ON_SOCKETS: dict[str, object] = {"bind": LOCAL}


@dataclass(frozen=True)
class ServiceConfig(Settings, section="service"):
    """How the processes work together; the same values serve master and workers."""

    bind: str = setting(
        LOCAL,
        "address that the master listens on; local: unix sockets, for processes of the same user "
        "on its machine",
    )
    port: int = setting(
        0,
        "of the master's ROUTER socket; the next one is its PUB socket's; 0: any two free ones",
        low=0,
        high=65534,
        unless=ON_SOCKETS,
    )
    host: str = setting(
        "",
        "name that workers find the master under; empty: bind, or this machine's name for 0.0.0.0",
        unless=ON_SOCKETS,
    )
    mode: str = setting(
        "async",
        "nobody waits for anybody, or lockstep: slower, and the same seed gives the same weights",
        choices=("async", "lockstep"),
    )
    auth: str = setting(
        "on",
        "workers need the connection file's keys; off, for tests: whoever reaches the port takes "
        "part, unencrypted",
        choices=("on", "off"),
        unless=ON_SOCKETS,
    )
    http_bind: str = setting(
        "127.0.0.1", "address of the master's /metrics and /healthz", unless={"http_port": -1}
    )
    http_port: int = setting(
        0, "their port, 0 for any free one (see connection.json), -1 for none", low=-1, high=65535
    )
    publish_seconds: float = setting(
        0.5,
        "least time between two broadcasts of weights; 0: after every update, as the paper does",
        low=0,
        unit="s",
        only={"mode": "async"},
    )
    envs: int = setting(
        0,
        "environments that one worker plays at a time; a message holds two episodes of each, fewer "
        "where they are too large for it. 0: 16, or fewer where episodes are longer than 8 steps, "
        "so that workers get new weights as often",
        low=0,
        high=512,
    )
    eval_seconds: float = setting(10.0, "least time between two evaluations", low=0, unit="s")
    eval_episodes: int = setting(100, "fixed test episodes of one evaluation", low=1, high=100_000)
    log_format: str = setting(
        "text", "of the lines that processes write: for people or for programs", choices=FORMATS
    )
    checkpoint_minutes: float = setting(5.0, "time between two checkpoints", low=1e-3, unit="min")
    journal_sync_seconds: float = setting(
        1.0, "time between two syncs of the journal to disk; 0: with each batch", low=0, unit="s"
    )
    # Heartbeats come every two seconds.
    silence_seconds: float = setting(
        30.0, "after which the master forgets a worker that says nothing", low=3, unit="s"
    )
    device: str = setting("auto", "of the learner", choices=("auto", "cpu", "cuda"))
    threads: int = setting(
        1,
        "torch threads of the master; more help on cores that nobody else uses, and are far slower "
        "than one where another process runs on theirs",
        low=1,
        high=1024,
    )
    compile: bool = setting(
        False,
        "whether an update is compiled as a whole: minutes at first and seconds later, then an "
        "update is 1.1 to 2.5 times as fast; needs g++ or clang++. On a GPU it is recorded in "
        "any case",
    )

    def envs_for(self, horizon: int) -> int:
        """Environments in which one worker plays episodes of so many steps."""
        return self.envs or min(MOST_ENVS, max(1, STEPS // horizon))

    def batch_episodes(self, horizon: int) -> int:
        """Episodes of so many steps in one message, where they are not too large for it."""
        return 2 * self.envs_for(horizon)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("bind", "http_bind"):
            check_host(f"service.{name}", getattr(self, name))
        if self.host:
            check_host("service.host", self.host)
