"""A finger pushes tokens into place on a table with hidden friction.

`task.py` has settings, rewards and scores, `places.py` defines a push, `env.py` simulates tables,
and `rivals.py` has the baselines. The engine is `tangram_sim.world.pushing`.
"""
