"""Baselines for tasks of tokens: formulas and rules that learned nothing.

Start with `baselines.py`. May import tangram_core, tangram_sim, `pairing.py` and `played.py`.
"""
