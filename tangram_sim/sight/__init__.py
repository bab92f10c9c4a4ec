"""What is seen of a world: pictures, what disturbs them, noise on corners, found tokens.

Start with `pictures.py`. May import tangram_sim.geometry; the camera itself is in
tangram_sim.world.
"""
