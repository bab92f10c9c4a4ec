"""What is to be assembled in an episode, and from where: targets and starts.

Start with `targets.py`. May import tangram_sim.motion, puzzles and geometry; no engine.
"""
