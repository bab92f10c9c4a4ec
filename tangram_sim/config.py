"""Settings of the simulated world and of the reward."""

from dataclasses import dataclass
from pathlib import Path

from tangram_sim.errors import ConfigError
from tangram_sim.layout import MAX_TOKENS
from tangram_sim.settings import check_choice, check_range

BACKENDS = ("physics", "kinematic")
REWARDS = ("overlap", "dense", "pose")
SOURCES = ("polygon", "camera")
# A step of Bullet is exact up to a turn of pi / 4 and turns too little beyond, so a half turn
# needs four.
MIN_SUBSTEPS = 4
# A fifth of the arena is a whole token: nothing is left to see beyond.
MAX_CORNER_NOISE = 0.2
MOTIONS = ("lift", "slide")
STARTS = ("anywhere", "outside")
TARGETS = ("uniform", "gaussian", "connected", "figures", "mixed")


@dataclass(frozen=True)
class StageConfig:
    """What is played from some update on: a step of a curriculum.

    Attributes:
        updates: the stage begins with the weights of so many updates.
        tokens: how many are to be moved, the others lie on their targets from the start; 0: all.
        targets: see `SimConfig`.
        spread: see `SimConfig`.
    """

    updates: int = 0
    tokens: int = 0
    targets: str = "uniform"
    spread: float = 0.2

    def __post_init__(self) -> None:
        check_range("sim.stages.updates", self.updates, 0)
        check_range("sim.stages.tokens", self.tokens, 0, MAX_TOKENS)
        check_choice("sim.stages.targets", self.targets, TARGETS)
        check_range("sim.stages.spread", self.spread, 1e-3, 1.0)


@dataclass(frozen=True)
class SimConfig:
    """The world that tokens move in.

    Attributes:
        backend: physics (PyBullet) or kinematic (the exact rigid motion, no engine).
        arena: side of the square arena, in the units of the tokens.
        actions_per_token: actions after which a token counts as placed.
        substeps: simulation steps in one action of one second (physics only).
        damping: Bullet's linear and angular damping (physics only), whose own default is 0.04.
        inexact: allow damping and fewer than 4 substeps, with which tokens fall short of what
            they are told; for experiments on what an agent makes of that.
        corner_noise: standard deviation of the Gaussian noise on the corners that agents see, as a
            share of the arena; rewards and scores are those of the exact corners.
        motion: lift (carried above the others, set down and settled) or slide (pushed along the
            table, and the others with it; physics only).
        max_overlap: lift: share of a token that may come to lie on others; a placement beyond it
            is refused and costs the action.
        targets: uniform (apart from each other, Sec. V), gaussian (their centres, Sec. VIII),
            connected (edge to edge), figures (of the package's train split, all seven tans), or
            mixed (uniform and connected in turns of chance).
        spread: gaussian: standard deviation of the centres, as a share of the arena.
        starts: anywhere in the arena, or outside of the target where there is room.
        mirrored: share of episodes whose chiral tokens lie on their other side, in start and
            target alike.
        allow_flip: the start's side is drawn, whatever the target's, and an action has one entry
            more, by which it turns its token over. Needs lift.
        stages: a curriculum, by the number of updates; tests are always the whole task.
        camera: take the pictures and report Eq. 14 from them at every step.
        pixels: side of the camera's square picture.
        max_tries: random poses tried for a token before sampling gives up.
    """

    backend: str = "physics"
    arena: float = 2.0
    actions_per_token: int = 1
    substeps: int = 8
    damping: float = 0.0
    inexact: bool = False
    corner_noise: float = 0.0
    motion: str = "lift"
    max_overlap: float = 0.2
    targets: str = "uniform"
    spread: float = 0.2
    starts: str = "anywhere"
    mirrored: float = 0.0
    allow_flip: bool = False
    stages: tuple[StageConfig, ...] = ()
    camera: bool = False
    pixels: int = 64
    max_tries: int = 1000

    @property
    def task(self) -> StageConfig:
        """What is played without a curriculum and before its first stage, and what tests are."""
        return StageConfig(targets=self.targets, spread=self.spread)

    def stage(self, updates: int) -> int:
        """The number of the stage that weights of so many updates play, 0 before the first."""
        return sum(stage.updates <= updates for stage in self.stages)

    def told(self, stage: int) -> str:
        """A stage in words, for logs."""
        task = self.stage_task(stage)
        count = f"{task.tokens} token{'s' * (task.tokens > 1)}" if task.tokens else "all tokens"
        moved = f"{count} to move"
        return f"stage {stage} of {len(self.stages)}: {moved}, targets {task.targets}" + (
            f" with spread {task.spread:g}" if task.targets == "gaussian" else ""
        )

    def stage_task(self, stage: int) -> StageConfig:
        """What is played in a stage."""
        return self.stages[stage - 1] if stage else self.task

    def __post_init__(self) -> None:
        check_choice("sim.backend", self.backend, BACKENDS)
        check_range("sim.arena", self.arena, 1e-3, 1e3)
        check_range("sim.actions_per_token", self.actions_per_token, 1, 100)
        check_range("sim.corner_noise", self.corner_noise, 0.0, MAX_CORNER_NOISE)
        self._check_motion()
        self._check_task()
        check_range("sim.pixels", self.pixels, 16, 1024)
        check_range("sim.max_tries", self.max_tries, 1, 1_000_000)

    def _check_task(self) -> None:
        check_choice("sim.targets", self.targets, TARGETS)
        check_choice("sim.starts", self.starts, STARTS)
        check_range("sim.spread", self.spread, 1e-3, 1.0)
        check_range("sim.mirrored", self.mirrored, 0.0, 1.0)
        entries: tuple[object, ...] = tuple(self.stages)
        wrong = [entry for entry in entries if not isinstance(entry, StageConfig)]
        if wrong:
            raise ConfigError(f"sim.stages must list stages, got {wrong[0]!r}")
        begins = [stage.updates for stage in self.stages]
        if begins != sorted(set(begins)):
            raise ConfigError(
                f"sim.stages must begin one after the other, got updates {begins}: sort them, and "
                "name each number once"
            )

    def _check_motion(self) -> None:
        check_choice("sim.motion", self.motion, MOTIONS)
        check_range("sim.max_overlap", self.max_overlap, 0.0, 1.0)
        if self.motion == "slide" and self.backend == "kinematic":
            raise ConfigError(
                "sim.motion=slide needs the engine's contacts, got sim.backend=kinematic: set "
                "sim.backend=physics, or sim.motion=lift"
            )
        if self.motion == "slide" and self.allow_flip:
            raise ConfigError(
                "sim.allow_flip=true needs sim.motion=lift, got slide: a token that stays on the "
                "table cannot be turned over"
            )
        check_range("sim.damping", self.damping, 0.0, 1.0)
        check_range("sim.substeps", self.substeps, 1 if self.inexact else MIN_SUBSTEPS, 1000)
        if self.damping > 0.0 and not self.inexact:
            raise ConfigError(
                f"sim.damping must be 0, got {self.damping}: tokens would stop short of what they "
                "are told; set sim.inexact=true for an experiment on that"
            )


@dataclass(frozen=True)
class RewardConfig:
    """What an action is worth.

    Attributes:
        name: overlap (Eq. 14), dense (Eq. 15), pose (corner distances modulo the symmetry), or
            `path/to/file.py:function` for one of the user's own.
        source: what Eq. 14 is measured on while playing: exact polygons or the camera's pictures.
        sharpness: dense and pose: how steep the logarithm is near the target; larger is steeper.
    """

    name: str = "overlap"
    source: str = "polygon"
    sharpness: float = 100.0

    def __post_init__(self) -> None:
        path, _, function = self.name.rpartition(":")
        if self.name not in REWARDS and not (path.endswith(".py") and function.isidentifier()):
            raise ConfigError(
                f"reward.name must be one of {', '.join(REWARDS)} or path/to/file.py:function, "
                f"got '{self.name}'"
            )
        check_choice("reward.source", self.source, SOURCES)
        check_range("reward.sharpness", self.sharpness, 1e-6, 1e9)
        if self.source == "camera" and self.name != "overlap":
            raise ConfigError(
                f"reward.source=camera measures Eq. 14 only, got reward.name={self.name}: "
                "set reward.source=polygon"
            )

    @property
    def own(self) -> tuple[Path, str] | None:
        """File and function of a reward of the user's own."""
        if self.name in REWARDS:
            return None
        path, _, function = self.name.rpartition(":")
        return Path(path).expanduser(), function
