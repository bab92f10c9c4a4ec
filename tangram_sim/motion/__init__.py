"""What an action means, and where it takes a token without an engine.

Start with `actions.py`. May import tangram_sim.geometry and tangram_sim.sight.
"""
