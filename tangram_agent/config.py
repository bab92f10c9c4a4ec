"""Settings of the networks, of the agent and of the service that trains it."""

from dataclasses import dataclass

from tangram_agent.logs import FORMATS
from tangram_sim.checks import check_choice, check_range
from tangram_sim.errors import ConfigError


@dataclass(frozen=True)
class NetConfig:
    """Size and kind of actor and critic.

    Attributes:
        kind: mha (Eqs. 8-13) or mlp.
        hidden: mlp: widths of the hidden layers.
        width: mha: size of a node's embedding.
        layers: mha: rounds of message passing.
        heads: mha: M in Eq. 12; each has the key width `width / heads`.
        feed_forward: mha: hidden width of g in Eq. 13; 0 is the literal single layer of Eq. 8.
        scale: mha: divide the scores of Eq. 10 by d (the paper) or by sqrt_d (learn2assemble).
    """

    kind: str = "mha"
    hidden: tuple[int, ...] = (64, 64)
    width: int = 64
    layers: int = 3
    heads: int = 4
    feed_forward: int = 512
    scale: str = "d"

    def __post_init__(self) -> None:
        check_choice("net.kind", self.kind, ("mha", "mlp"))
        check_choice("net.scale", self.scale, ("d", "sqrt_d"))
        check_range("net.layers", self.layers, 1, 64)
        check_range("net.heads", self.heads, 1, 64)
        check_range("net.width", self.width, 1, 4096)
        check_range("net.feed_forward", self.feed_forward, 0, 65536)
        if self.width % self.heads:
            raise ConfigError(
                f"net.width must be a multiple of net.heads, got {self.width} and {self.heads}"
            )
        if not self.hidden:
            raise ConfigError("net.hidden must name at least one layer, got []")
        for size in self.hidden:
            check_range("net.hidden", size, 1, 65536)


ORDERS = ("learned", "listed", "size", "random")
STRATEGIES = ("final", "future", "near", "none")


@dataclass(frozen=True)
class RelabelConfig:
    """One kind of hindsight twin that is added for every transition played.

    Attributes:
        strategy: final, future, near (the final pose moved by Gaussian noise), or none. On pairs
            final and future are one: where the token came to lie by its action.
        copies: twins of this kind for each transition.
        position: near: standard deviation of the goal's shift, in arena units.
        angle: near: standard deviation of the goal's turn, in radians.
    """

    strategy: str
    copies: int = 1
    position: float = 0.0
    angle: float = 0.0

    def __post_init__(self) -> None:
        check_choice("agent.hindsight.strategy", self.strategy, STRATEGIES)
        check_range("agent.hindsight.copies", self.copies, 1, 64)
        check_range("agent.hindsight.position", self.position, 0.0)
        check_range("agent.hindsight.angle", self.angle, 0.0)


@dataclass(frozen=True)
class AgentConfig:
    """DDPG, hindsight and the ways in which an agent may see the graph.

    Attributes:
        name: preset's name, for reports.
        egocentric: coordinates relative to the moving token, in its own orientation.
        offsets: each corner's displacement from its token's centre as node features.
        orientation: (cos k*theta, sin k*theta) of each target relative to the moving token.
        edges: of the graph: paper (Sec. IV-A) or complete (every node sees every other).
        afterstate: the critic sees the graph as the action would leave it.
        angle_head: plain (one output) or kfold (two outputs, angle = atan2 / k).
        squash: of the actor's outputs: tanh (the paper) or clamp.
        saturation_penalty: weight of mean(relu(|z| - saturation_limit)^2) in the actor's loss.
        saturation_limit: pre-activation beyond which the penalty starts.
        readout: token (one velocity of a given token, the next one in the set's order, which is
            never turned over), pair (a pose for every pair of a token and a piece of the target,
            and its value), or auto: pair for several tokens. On pairs the settings from egocentric
            to squash are not used: their graph has all of it, see `pairs`.
        order: pair: which token is next: learned (the one with the best value), listed (as in the
            set), size (the largest first) or random.
        reapply: pair: how often the actor is applied again to its own proposals before one is
            chosen; 0 is not.
        refine_steps: pair: gradient steps that the chosen pose makes uphill on what it covers by
            the critic before it is played, exploration off.
        refine_rate: pair: length of the first of these steps, in arena units and radians.
        pairs_per_transition: pair: pairs that a transition gives in one update.
        gamma: discount, Eq. 5. On pairs the weight of what later tokens push away again, see
            `pair_damage`: it has no effect where tokens are lifted.
        polyak: rho of the target networks, Eq. 4.
        acting_average: Polyak average of the actor that plays and is scored, less in the first
            updates (see `ddpg.average_so_far`); 0 is the actor.
        actor_lr, critic_lr: Adam's learning rates at the start.
        lr_decay: none or cosine over the run's budget.
        lr_final: share of the learning rate that cosine decay ends at.
        grad_clip: largest norm of a gradient; 0 is no clipping.
        batch_size: transitions in one update.
        replay_capacity: transitions kept.
        updates_per_transition: pace: updates for each transition played.
        learning_starts: transitions played before the first update; twins do not count.
        noise: standard deviation of the Gaussian exploration noise on actions.
        uniform_share: share of actions drawn uniformly.
        hindsight: the twins added for every transition.
    """

    name: str = "tangram"
    egocentric: bool = True
    offsets: bool = True
    orientation: bool = True
    edges: str = "paper"
    afterstate: bool = True
    angle_head: str = "kfold"
    squash: str = "clamp"
    saturation_penalty: float = 1.0
    saturation_limit: float = 1.0
    readout: str = "auto"
    order: str = "learned"
    reapply: int = 0
    refine_steps: int = 0
    refine_rate: float = 0.004
    pairs_per_transition: int = 8
    gamma: float = 0.0
    polyak: float = 0.995
    acting_average: float = 0.99
    actor_lr: float = 1e-3
    critic_lr: float = 1e-3
    lr_decay: str = "cosine"
    lr_final: float = 0.01
    grad_clip: float = 0.0
    batch_size: int = 64
    replay_capacity: int = 200_000
    updates_per_transition: float = 0.1
    learning_starts: int = 512
    noise: float = 0.05
    uniform_share: float = 0.2
    hindsight: tuple[RelabelConfig, ...] = (RelabelConfig("final"),)

    def __post_init__(self) -> None:
        check_choice("agent.angle_head", self.angle_head, ("plain", "kfold"))
        check_choice("agent.edges", self.edges, ("paper", "complete"))
        check_choice("agent.squash", self.squash, ("tanh", "clamp"))
        check_choice("agent.lr_decay", self.lr_decay, ("none", "cosine"))
        self._check_pairs()
        for name in ("gamma", "polyak", "acting_average", "lr_final", "uniform_share"):
            check_range(f"agent.{name}", getattr(self, name), 0.0, 1.0)
        for name in ("saturation_penalty", "saturation_limit", "grad_clip", "noise"):
            check_range(f"agent.{name}", getattr(self, name), 0.0)
        for name in ("actor_lr", "critic_lr", "updates_per_transition"):
            check_range(f"agent.{name}", getattr(self, name), 1e-9, 1e3)
        for name in ("batch_size", "replay_capacity", "learning_starts"):
            check_range(f"agent.{name}", getattr(self, name), 1)
        self._check_capacity()

    def _check_pairs(self) -> None:
        check_choice("agent.readout", self.readout, ("auto", "token", "pair"))
        check_choice("agent.order", self.order, ORDERS)
        check_range("agent.reapply", self.reapply, 0, 100)
        check_range("agent.refine_steps", self.refine_steps, 0, 10_000)
        check_range("agent.refine_rate", self.refine_rate, 1e-9, 1.0)
        check_range("agent.pairs_per_transition", self.pairs_per_transition, 1, 1024)

    def _check_capacity(self) -> None:
        if self.batch_size > self.replay_capacity:
            raise ConfigError(
                f"agent.batch_size ({self.batch_size}) must not exceed "
                f"agent.replay_capacity ({self.replay_capacity})"
            )


@dataclass(frozen=True)
class ServiceConfig:
    """How the processes work together; the same values serve master and workers.

    Attributes:
        bind: address that the master listens on.
        port: of the master's ROUTER socket, 0 for any free one.
        weights_port: of its PUB socket, 0 for any free one.
        host: name or address that workers find the master under; empty: `bind`, or the name of the
            master's machine where `bind` stands for all of its addresses.
        mode: async (nobody waits for anybody), or lockstep (the same seed gives the same weights).
        lockstep_workers: players that lockstep waits for; tangram-train knows it.
        security: curve (encrypted, and only for who has the run's connection file), plain, or
            auto: curve on every address but loopback.
        http_bind: address of the master's /metrics and /healthz.
        http_port: their port, 0 for any free one, -1 for none.
        publish_seconds: least time between two broadcasts of weights.
        every_update: broadcast after every update instead, as the paper does.
        envs: environments that one worker plays at a time.
        batch_episodes: episodes in one message.
        window: messages of a worker that may be unacknowledged; a full window pauses play.
        lag_updates: updates that the learner may lag behind before workers must wait.
        eval_seconds: least time between two evaluations.
        eval_episodes: fixed test episodes of one evaluation.
        log_format: of the lines that processes write: text for people, json for programs.
        log_seconds: time between two lines of progress and TensorBoard scalars.
        checkpoint_minutes: time between two checkpoints.
        keep_checkpoints: newest checkpoints kept.
        journal_sync_seconds: time between two syncs of the journal, 0 for every batch.
        max_bad_updates: updates in a row that may be undone because they are not finite.
        silence_seconds: after which the master forgets a worker that says nothing.
        watchdog_seconds: a process that makes no progress for so long ends, 0: never.
        device: auto, cpu or cuda.
        threads: torch threads of the master.
    """

    bind: str = "127.0.0.1"
    port: int = 0
    weights_port: int = 0
    host: str = ""
    mode: str = "async"
    lockstep_workers: int = 0
    security: str = "auto"
    http_bind: str = "127.0.0.1"
    http_port: int = 0
    publish_seconds: float = 0.5
    every_update: bool = False
    envs: int = 16
    batch_episodes: int = 32
    window: int = 4
    lag_updates: int = 64
    eval_seconds: float = 10.0
    eval_episodes: int = 100
    log_format: str = "text"
    log_seconds: float = 2.0
    checkpoint_minutes: float = 5.0
    keep_checkpoints: int = 2
    journal_sync_seconds: float = 1.0
    max_bad_updates: int = 10
    silence_seconds: float = 30.0
    watchdog_seconds: float = 300.0
    device: str = "auto"
    threads: int = 1

    def __post_init__(self) -> None:
        check_range("service.port", self.port, 0, 65535)
        check_range("service.weights_port", self.weights_port, 0, 65535)
        # Heartbeats come every two seconds.
        check_range("service.silence_seconds", self.silence_seconds, 3.0)
        check_range("service.http_port", self.http_port, -1, 65535)
        check_range("service.envs", self.envs, 1, 512)
        check_range("service.batch_episodes", self.batch_episodes, 1, 4096)
        check_range("service.window", self.window, 1, 1024)
        check_range("service.eval_episodes", self.eval_episodes, 1, 100_000)
        check_range("service.keep_checkpoints", self.keep_checkpoints, 1, 1000)
        check_range("service.max_bad_updates", self.max_bad_updates, 1)
        check_range("service.threads", self.threads, 1, 1024)
        # Without any lag a worker would wait for updates that wait for its episodes.
        check_range("service.lag_updates", self.lag_updates, 1)
        for name in (
            "publish_seconds",
            "eval_seconds",
            "journal_sync_seconds",
            "watchdog_seconds",
        ):
            check_range(f"service.{name}", getattr(self, name), 0)
        for name in ("log_seconds", "checkpoint_minutes"):
            check_range(f"service.{name}", getattr(self, name), 1e-3)
        check_choice("service.mode", self.mode, ("async", "lockstep"))
        check_range("service.lockstep_workers", self.lockstep_workers, 0, 4096)
        check_choice("service.security", self.security, ("auto", "curve", "plain"))
        check_choice("service.log_format", self.log_format, FORMATS)
        check_choice("service.device", self.device, ("auto", "cpu", "cuda"))
