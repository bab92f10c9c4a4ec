"""Settings of the service: how the processes of a run work together."""

from dataclasses import dataclass

from tangram_core.run.process import FORMATS
from tangram_core.settings import Settings, setting
from tangram_core.wire.addresses import LOCAL, check_host

MOST_ENVS, STEPS = 16, 128  # for service.envs=0: environments, and steps of all their episodes
ON_SOCKETS: dict[str, object] = {"bind": LOCAL}


@dataclass(frozen=True)
class ServiceConfig(Settings, section="service"):
    """Settings of the section `service`, for master and workers."""

    bind: str = setting(
        LOCAL,
        "address that the master listens on; local: unix sockets, for processes of the same user "
        "on the same machine",
    )
    port: int = setting(
        0,
        "port of the master, which also takes the next one for broadcasts; 0: any two free ports",
        low=0,
        high=65534,
        unless=ON_SOCKETS,
    )
    host: str = setting(
        "",
        "name or address of the master for workers; empty: bind, or the machine's name if bind is "
        "0.0.0.0",
        unless=ON_SOCKETS,
    )
    mode: str = setting(
        "async",
        "async: no process waits for another; lockstep: slower, and the same seed gives the same "
        "weights",
        choices=("async", "lockstep"),
    )
    auth: str = setting(
        "on",
        "on: encrypted, and workers need a key from the connection file; off, for tests: "
        "unencrypted, and everybody who reaches the port can take part",
        choices=("on", "off"),
        unless=ON_SOCKETS,
    )
    http_bind: str = setting(
        "127.0.0.1",
        "address of the master's HTTP pages /metrics and /healthz",
        unless={"http_port": -1},
    )
    http_port: int = setting(
        0,
        "port of these pages; 0: any free port, written to connection.json; -1: no pages",
        low=-1,
        high=65535,
    )
    publish_seconds: float = setting(
        0.5,
        "least time between two broadcasts of weights; 0: after every update, as in the paper",
        low=0,
        unit="s",
        only={"mode": "async"},
    )
    envs: int = setting(
        0,
        "environments that one worker plays at a time. A message holds two episodes of each, or "
        "fewer if they are too large for one message. 0: 16, or fewer if episodes have more than 8 "
        "steps, so that workers get new weights as often",
        low=0,
        high=512,
    )
    eval_seconds: float = setting(10.0, "least time between two evaluations", low=0, unit="s")
    eval_episodes: int = setting(
        100, "test episodes of each evaluation, always the same", low=1, high=100_000
    )
    log_format: str = setting(
        "text", "format of log lines: text for people, json for programs", choices=FORMATS
    )
    checkpoint_minutes: float = setting(5.0, "time between two checkpoints", low=1e-3, unit="min")
    journal_sync_seconds: float = setting(
        1.0, "time between two syncs of the journal to disk; 0: after each batch", low=0, unit="s"
    )
    # Heartbeats come every two seconds.
    silence_seconds: float = setting(
        30.0, "time without a message after which the master removes a worker", low=3, unit="s"
    )
    device: str = setting("auto", "torch device of the learner", choices=("auto", "cpu", "cuda"))
    threads: int = setting(
        1,
        "torch threads of the master. More than one is faster on idle cores, and far slower on "
        "cores that another process uses",
        low=1,
        high=1024,
    )
    compile: bool = setting(
        False,
        "compile the whole update. This takes minutes the first time and seconds later, then an "
        "update is 1.1 to 2.5 times as fast. Needs g++ or clang++. On a GPU updates are always "
        "recorded as a CUDA graph",
    )

    def envs_for(self, horizon: int) -> int:
        """Number of environments of one worker, for episodes of `horizon` steps."""
        return self.envs or min(MOST_ENVS, max(1, STEPS // horizon))

    def batch_episodes(self, horizon: int) -> int:
        """Number of episodes in one message, unless they are too large for it."""
        return 2 * self.envs_for(horizon)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("bind", "http_bind"):
            check_host(f"service.{name}", getattr(self, name))
        if self.host:
            check_host("service.host", self.host)
