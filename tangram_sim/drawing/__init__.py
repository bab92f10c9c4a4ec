"""Pictures of scenes and of the game for people, from corners only.

Start with `scenes.py`. May import tangram_sim.geometry; neither engine nor camera.
"""
