"""The world of Tangram. `import tangram_sim.register` makes its ids known to gymnasium.

Start with `batch.py`: many environments in step. `env.py` and `vector.py` are gymnasium's,
`config.py` and `rewards.py` are everybody's. Folders, each imports those behind it only: world,
tasks, motion, sight | puzzles | drawing, geometry. May import tangram_core; no torch.
"""
