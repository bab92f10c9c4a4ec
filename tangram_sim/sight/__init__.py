"""Perception: pictures of a world, and the tokens that are found in them.

Start with `pictures.py`. May import tangram_sim.geometry; the camera itself is in
tangram_sim.world.
"""
