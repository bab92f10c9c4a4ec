"""Importing this module registers `Tangram-v0` with gymnasium.

    gymnasium.make("tangram_sim.register:Tangram-v0", shapes=["square"])

imports it by itself; after `import tangram_sim.register` the plain name does. gymnasium 1.0 no
longer loads environments through entry points. The environment is registered by name, so that
neither it nor the engine is loaded before one is made.
"""

import gymnasium

ENV_ID = "Tangram-v0"


def register() -> None:
    """Make `gymnasium.make("Tangram-v0")` work; calling it twice does no harm."""
    if ENV_ID not in gymnasium.registry:
        gymnasium.register(id=ENV_ID, entry_point="tangram_sim.env:TangramEnv")


register()
