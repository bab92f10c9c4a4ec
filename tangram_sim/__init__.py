"""The world of Tangram.

Start with `batch.py`: many environments in step. `config.py` and `rewards.py` are everybody's.
Folders, each imports those behind it only: world, targets, motion, sight | puzzles | drawing,
geometry. May import tangram_core; no torch.
"""
