"""The simulated world: geometry, motion, perception, targets and rewards.

Start with `batch.py`: many environments that step together. A folder imports only folders after it
in this list: world, targets, motion, sight | puzzles | drawing, geometry. All but geometry may use
`config.py` and `rewards.py`. May import tangram_core; no torch.
"""
