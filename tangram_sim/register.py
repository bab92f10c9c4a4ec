"""The ids of gymnasium: after `import tangram_sim`, `gymnasium.make("Tangram-v0")` works.

gymnasium 1.0 no longer loads environments through entry points, so the import registers them. It
does not load gymnasium, which masters and command lines do without: where that is not loaded yet,
the ids are registered as soon as it is. Neither the environment nor the engine is loaded before
one is made.
"""

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

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


def register() -> None:
    """Register the ids; calling it twice does no harm."""
    import gymnasium  # noqa: PLC0415 - see above

    for name, settings in KWARGS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                id=name,
                entry_point="tangram_sim.env:TangramEnv",
                vector_entry_point="tangram_sim.vector:TangramVectorEnv",
                max_episode_steps=settings["horizon"],
                kwargs=settings,
            )


def register_when_loaded() -> None:
    """Register the ids now, or once gymnasium is imported."""
    if sys.modules.get("gymnasium") is not None:  # None keeps it from being imported
        register()
    else:
        sys.meta_path.insert(0, _Finder())


class _Finder(MetaPathFinder):
    """Finds gymnasium as the finders behind it do; once it has run, the ids are registered."""

    _looks = False

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != "gymnasium" or self._looks:
            return None
        self._looks = True  # another of this kind, as after a reload, asks this one in its turn
        try:
            others = [finder for finder in sys.meta_path if finder is not self]
            found = (finder.find_spec(fullname, path, target) for finder in others)
            spec = next((one for one in found if one is not None), None)
        finally:
            self._looks = False
        if spec is not None and spec.loader is not None:
            run = spec.loader.exec_module

            def run_and_register(module: ModuleType) -> None:
                run(module)
                if self in sys.meta_path:
                    sys.meta_path.remove(self)
                register()

            spec.loader.exec_module = run_and_register  # type: ignore[method-assign]
        return spec
