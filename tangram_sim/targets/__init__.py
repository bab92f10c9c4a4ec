"""Targets and starts of episodes.

Start with `targets.py`. May import tangram_sim.motion, puzzles and geometry; no engine.
"""
