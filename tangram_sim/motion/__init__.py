"""Meaning of actions, and exact motion of tokens without an engine.

Start with `actions.py`. May import tangram_sim.geometry and tangram_sim.sight.
"""
