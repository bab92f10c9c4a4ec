"""Shared settings of agents: networks, hindsight and learning."""

from dataclasses import dataclass, field

from tangram_core.errors import ConfigError
from tangram_core.settings import LEARNING, Settings, declared, setting

HEADS = 4  # M in Eq. 12, each of the key width d = width / M
STRATEGIES = ("final", "future", "near")


@dataclass(frozen=True)
class NetConfig(Settings, section="net"):
    """Size and kind of the networks; the defaults are the paper's."""

    kind: str = setting(
        "mha",
        "mha: attention network (Eqs. 8-13); mlp: multi-layer perceptron",
        choices=("mha", "mlp"),
    )
    hidden: tuple[int, ...] = setting(
        (64, 64),
        "widths of the hidden layers",
        low=1,
        high=65536,
        only={"kind": "mlp"},
    )
    activation: str = setting(
        "relu",
        "activation function between the layers",
        choices=("relu", "tanh"),
        only={"kind": "mlp"},
    )
    width: int = setting(64, "size of a node's embedding", low=1, high=4096, only={"kind": "mha"})
    layers: int = setting(3, "rounds of message passing", low=1, high=64, only={"kind": "mha"})
    feed_forward: int = setting(
        512,
        "hidden width of g in Eq. 13",
        low=1,
        high=65536,
        only={"kind": "mha"},
    )
    rectified: bool = setting(
        False,
        "ReLU after the embedding (Eq. 8) and before the last layer",
        only={"kind": "mha"},
    )
    init: str = setting(
        "fan_in",
        "fan_in: weights are drawn within 1 / sqrt(inputs); authors: queries, keys and values "
        "within 1 / sqrt(width of a head), the embedding by Glorot and Bengio (2010) for ReLU",
        choices=("fan_in", "authors"),
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
    """One kind of hindsight goal, with which transitions are learned besides the played goal."""

    strategy: str = field(
        metadata=declared(
            "final: the state at the end of the episode; future: a random later state; near: the "
            "final poses with Gaussian noise; with several tokens agent=pair uses the pose after "
            "the action as final",
            choices=STRATEGIES,
        )
    )
    copies: int = setting(1, "goals of this kind for each transition", low=1, high=64)
    position: float = setting(
        0.0,
        "standard deviation of the goal's shift",
        low=0,
        high=1e3,
        unit="arena units",
        only={"strategy": "near"},
    )
    angle: float = setting(
        0.0,
        "standard deviation of the goal's turn",
        low=0,
        high=100,
        unit="rad",
        only={"strategy": "near"},
    )


@dataclass(frozen=True)
class LearningConfig(Settings, section="agent"):
    """Settings of gradient learning from a replay buffer."""

    name: str = setting("tangram", "the preset's name, for reports", part=LEARNING)
    acting_average: float = setting(
        0.99,
        "rho of the Polyak average of the weights that play and are scored; 0: no average",
        low=0,
        high=1,
        part=LEARNING,
    )
    critic_lr: float = setting(
        1e-3, "the critic's learning rate at the start", low=1e-9, high=1e3, part=LEARNING
    )
    lr_final: float = setting(
        0.01,
        "share of the learning rates at the end of the budget; they fall along a cosine; 1: no "
        "decay",
        low=0,
        high=1,
        part=LEARNING,
    )
    batch_size: int = setting(64, "transitions in one update", low=1, part=LEARNING)
    replay_capacity: int = setting(
        200_000,
        "transitions kept in the replay buffer",
        low=1,
        high=1_000_000_000,
        part=LEARNING,
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
    uniform_share: float = setting(
        0.2, "share of random exploring actions", low=0, high=1, part=LEARNING
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.batch_size > self.replay_capacity:
            raise ConfigError(
                f"agent.batch_size ({self.batch_size}) must not exceed "
                f"agent.replay_capacity ({self.replay_capacity})"
            )


@dataclass(frozen=True)
class ActorCriticConfig(LearningConfig, section="agent"):
    """Settings of DDPG with hindsight."""

    saturation_penalty: float = setting(
        1.0,
        "weight of squared pre-activations in the actor's loss",
        low=0,
        part=LEARNING,
    )
    gamma: float = setting(
        0.0,
        "discount factor, Eq. 5; without effect in episodes of one action",
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
    actor_lr: float = setting(
        1e-3, "the actor's learning rate at the start", low=1e-9, high=1e3, part=LEARNING
    )
    noise: float = setting(
        0.05,
        "standard deviation of the Gaussian exploration noise on actions",
        low=0,
        part=LEARNING,
    )
    # With one action every exact relabel scores +1: only near misses show how rewards fall.
    hindsight: tuple[RelabelConfig, ...] = setting(
        (
            RelabelConfig("final"),
            RelabelConfig("near", position=0.1, angle=0.5),
            RelabelConfig("near", position=0.02, angle=0.1),
        ),
        "hindsight goals with which every transition is learned, too; []: none",
        part=LEARNING,
    )
