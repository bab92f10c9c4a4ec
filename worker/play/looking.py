"""How a worker looks at pictures, where these are what its agent observes."""

from tangram_agent.setup import Setup
from tangram_core.arrays import Pixels
from tangram_sim.batch import BatchedEnv
from tangram_sim.config import RewardConfig
from tangram_sim.sight.perception import Eye, Look
from tangram_sim.world.world import no_opencv


def environments(setup: Setup, count: int, reward: RewardConfig | None = None) -> BatchedEnv:
    """So many environments of a run, to be closed by whoever asked; perhaps with another reward."""
    paid = reward or setup.reward
    return BatchedEnv(setup.layout, setup.sim, paid, count, make_eye(setup), setup.fills)


def make_eye(setup: Setup) -> Eye | None:
    """What finds the tokens of a run in pictures; None where corners are observed.

    Raises:
        ConfigError: OpenCV is not installed.
    """
    if not setup.sim.looks:
        return None
    try:
        # Only here: most workers look at nothing, and its import takes time and memory.
        from tangram_vision.pictures.seeing import see  # noqa: PLC0415
    except ImportError as error:  # also a library that OpenCV needs in its turn
        raise no_opencv(str(error)) from error
    layout, arena = setup.layout, setup.sim.arena

    def look(picture: Pixels, before: Look | None = None) -> Look:
        return see(picture, layout, arena, before)

    return look
