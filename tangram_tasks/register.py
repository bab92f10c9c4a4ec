"""Gymnasium ids: after `import tangram_tasks.register`, `gymnasium.make("Push-v0")` works.

Environment and engine are imported when the first environment is made.
"""

from typing import Any

import gymnasium

SEVEN = (
    *("large_triangle", "large_triangle", "medium_triangle", "small_triangle", "small_triangle"),
    *("square", "parallelogram"),
)
# Id -> function of `goal_env`, and the arguments that differ from its defaults.
IDS: dict[str, tuple[str, dict[str, Any]]] = {
    "Tangram-v0": ("place", {}),  # the paper's task, which pretrained/square plays
    "Tangram7-v0": (
        "place",
        {"shapes": SEVEN, "scale": 0.6, "starts": "outside", "mirrored": 0.5},
    ),
    "Push-v0": ("push", {}),
    "Push2-v0": ("push", {"shapes": ("square", "small_triangle")}),
    "Push7-v0": ("push", {"shapes": SEVEN, "scale": 0.6}),
}


for _name, (_task, _settings) in IDS.items():
    if _name not in gymnasium.registry:  # a reloaded module registers nothing twice
        gymnasium.register(
            id=_name, entry_point=f"tangram_tasks.goal_env:{_task}", kwargs=_settings
        )
