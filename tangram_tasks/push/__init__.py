"""A finger pushes tokens into place on a table whose friction nobody is told.

`task.py` says what is played and what it is worth, `places.py` what a push is, `env.py` plays, and
the others learned nothing. The engine is `tangram_sim.world.pushing`.
"""
