"""Settings of the networks, of the agent and of the service that trains it."""

from dataclasses import dataclass, field

from tangram_core.errors import ConfigError
from tangram_core.process import FORMATS
from tangram_core.settings import LEARNING, NETWORK, Settings, declared, setting
from tangram_core.wire.addresses import LOCAL, check_host

HEADS = 4  # M in Eq. 12, each of the key width d = width / M
STRATEGIES = ("final", "future", "near")
ON_SOCKETS: dict[str, object] = {"bind": LOCAL}


@dataclass(frozen=True)
class NetConfig(Settings, section="net"):
    """Size and kind of the networks; the defaults are the paper's."""

    kind: str = setting(
        "mha",
        "attention network (Eqs. 8-13) or perceptron",
        choices=("mha", "mlp"),
    )
    hidden: tuple[int, ...] = setting(
        (64, 64),
        "widths of the hidden layers",
        low=1,
        high=65536,
        only={"kind": "mlp"},
    )
    width: int = setting(64, "size of a node's embedding", low=1, high=4096, only={"kind": "mha"})
    layers: int = setting(3, "rounds of message passing", low=1, high=64, only={"kind": "mha"})
    feed_forward: int = setting(
        512,
        "hidden width of g in Eq. 13; 0: the single layer of Eq. 8",
        low=0,
        high=65536,
        only={"kind": "mha"},
    )
    scale: str = setting(
        "d",
        "Eq. 10 divides the scores by d (the paper) or by sqrt_d (learn2assemble)",
        choices=("d", "sqrt_d"),
        only={"kind": "mha"},
    )

    def __post_init__(self) -> None:
        if not self.hidden:
            raise ConfigError("net.hidden must name at least one layer, got []")
        super().__post_init__()
        if self.width % HEADS:
            raise ConfigError(f"net.width must be a multiple of {HEADS}, got {self.width}")


@dataclass(frozen=True)
class RelabelConfig(Settings, section="agent.hindsight"):
    """One kind of other goal that transitions are learned with besides the one that was played."""

    strategy: str = field(
        metadata=declared(
            "the goal: final, future or near (the final pose moved by Gaussian noise); "
            "pairs of several tokens: where the token came to lie by its action is final",
            choices=STRATEGIES,
        )
    )
    copies: int = setting(1, "goals of this kind for each transition", low=1, high=64)
    position: float = setting(
        0.0,
        "deviation of the goal's shift",
        low=0,
        high=1e3,
        unit="arena units",
        only={"strategy": "near"},
    )
    angle: float = setting(
        0.0,
        "deviation of the goal's turn",
        low=0,
        high=100,
        unit="rad",
        only={"strategy": "near"},
    )


@dataclass(frozen=True)
class AgentConfig(Settings, section="agent"):
    """DDPG, hindsight and what an agent sees: `readout`."""

    name: str = setting("tangram", "the preset's name, for reports", part=LEARNING)
    motion: str = setting(
        "learned",
        "what a command comes to: learned from the replay, and watched in each episode; or the "
        "exact rigid motion",
        choices=("learned", "exact"),
        only={"readout": "pair"},
        part=NETWORK,
    )
    saturation_penalty: float = setting(
        1.0,
        "weight in the actor's loss of squared pre-activations; of an agent of pairs, beyond 1",
        low=0,
        part=LEARNING,
    )
    readout: str = setting(
        "pair",
        "a velocity and a value for each pair of a token and a piece of the target; or, as in the "
        "paper, one velocity of the set's next token and one value of the whole scene; or, of "
        "sim.observe=silhouette, a value of what is left to fill, whose actions are exact",
        choices=("pair", "token", "outline"),
        part=NETWORK,
    )
    reapply: int = setting(
        2,
        "times that the actor is applied again to what it proposed",
        low=0,
        high=100,
        only={"readout": "pair"},
    )
    beam: int = setting(
        1,
        "exploration off: lay all tokens in thought first, and follow so many fillings of each "
        "depth, by the values of what would be left; 1: play what is best now",
        low=1,
        high=32,
        only={"readout": "outline"},
    )
    gamma: float = setting(
        0.0,
        "discount, Eq. 5; one action in an episode leaves nothing to discount",
        low=0,
        high=1,
        part=LEARNING,
    )
    polyak: float = setting(
        0.995,
        "rho of the target networks, Eq. 4",
        low=0,
        unless={"gamma": 0.0},
        high=1,
        part=LEARNING,
    )
    acting_average: float = setting(
        0.99,
        "Polyak average of the actor that plays and is scored; 0 is the actor",
        low=0,
        high=1,
        part=LEARNING,
    )
    actor_lr: float = setting(
        1e-3, "the actor's learning rate at the start", low=1e-9, high=1e3, part=LEARNING
    )
    critic_lr: float = setting(
        1e-3, "the critic's learning rate at the start", low=1e-9, high=1e3, part=LEARNING
    )
    lr_final: float = setting(
        0.01,
        "share of the learning rates that their cosine over the run's budget ends at; 1: no decay",
        low=0,
        high=1,
        part=LEARNING,
    )
    batch_size: int = setting(64, "transitions in one update", low=1, part=LEARNING)
    replay_capacity: int = setting(
        200_000, "transitions kept", low=1, high=1_000_000_000, part=LEARNING
    )
    updates_per_transition: float = setting(
        0.1, "updates for each transition played", low=1e-9, high=1e3, part=LEARNING
    )
    learning_starts: int = setting(
        512,
        "transitions played before the first update; relabelled ones do not count",
        low=1,
        part=LEARNING,
    )
    noise: float = setting(
        0.05, "deviation of the Gaussian exploration noise on actions", low=0, part=LEARNING
    )
    uniform_share: float = setting(
        0.2, "share of actions drawn uniformly", low=0, high=1, part=LEARNING
    )
    # With one action every plain relabel scores +1, so only near misses teach the slope.
    hindsight: tuple[RelabelConfig, ...] = setting(
        (
            RelabelConfig("final"),
            RelabelConfig("near", position=0.1, angle=0.5),
            RelabelConfig("near", position=0.02, angle=0.1),
        ),
        "the other goals that every transition is learned with; []: none",
        part=LEARNING,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.batch_size > self.replay_capacity:
            raise ConfigError(
                f"agent.batch_size ({self.batch_size}) must not exceed "
                f"agent.replay_capacity ({self.replay_capacity})"
            )


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
        16,
        "environments that one worker plays at a time; a message holds two episodes of each, fewer "
        "where they are too large for it",
        low=1,
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
    threads: int = setting(1, "torch threads of the master", low=1, high=1024)
    compile: bool = setting(
        False,
        "whether an update is compiled as a whole: up to a minute at first and seconds later, then "
        "an update is 1.1 to 2.5 times as fast, on a GPU 6 to 13; needs g++ or clang++",
    )

    @property
    def batch_episodes(self) -> int:
        """Episodes in one message, where they are not too large for it."""
        return 2 * self.envs

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("bind", "http_bind"):
            check_host(f"service.{name}", getattr(self, name))
        if self.host:
            check_host("service.host", self.host)
