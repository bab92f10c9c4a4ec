"""The world of Tangram. Importing it registers its ids with gymnasium; see `register`.

Start with `batch.py`: many environments in step. `env.py` and `vector.py` are gymnasium's,
`config.py` and `rewards.py` are everybody's. Folders, each imports those behind it only: world,
tasks, motion, sight | puzzles | drawing, geometry. May import tangram_core; no torch.
"""

from tangram_sim.register import register_when_loaded

register_when_loaded()
