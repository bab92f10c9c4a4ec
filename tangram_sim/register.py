"""The ids of gymnasium: after `import tangram_sim.register`, `gymnasium.make("Tangram-v0")` works.

Neither the environment nor the engine is loaded before one is made.
"""

from typing import Any

import gymnasium

ENV_ID = "Tangram-v0"  # one square: the paper's task, and what pretrained/square plays
GAME_ID = "Tangram7-v0"  # all seven tans, as pretrained/tangram7 plays

# Where they differ from the defaults of TangramEnv; the horizon is that of the time limit.
KWARGS: dict[str, dict[str, Any]] = {
    ENV_ID: {"horizon": 1},
    GAME_ID: {
        "shapes": (
            "large_triangle",
            "large_triangle",
            "medium_triangle",
            "small_triangle",
            "small_triangle",
            "square",
            "parallelogram",
        ),
        "scale": 0.6,
        "starts": "outside",
        "mirrored": 0.5,
        "horizon": 7,
    },
}


for _name, _settings in KWARGS.items():
    if _name not in gymnasium.registry:  # else the module was loaded again
        gymnasium.register(
            id=_name,
            entry_point="tangram_sim.env:TangramEnv",
            max_episode_steps=_settings["horizon"],
            kwargs=_settings,
        )
