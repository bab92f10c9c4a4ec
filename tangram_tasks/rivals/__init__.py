"""Baselines for tasks of tokens: formulas and rules that learned nothing.

Start with `baselines.py`; `search.py` is for outlines. May import tangram_core, tangram_sim,
tangram_vision, `pairing.py` and `played.py`.
"""
