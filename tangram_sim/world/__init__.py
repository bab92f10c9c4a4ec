"""Simulated worlds in which tokens move: by PyBullet, or by exact motion.

Start with `world.py`, which defines the interface and makes a world. `physics.py` carries tokens,
`pushing.py` pushes them with a finger, `arm.py` and `stage.py` are a robot's arm and its pictures.
All modules except `world.py` load the engine. May import all other folders of tangram_sim.
"""
