"""The arena and what moves tokens in it: PyBullet, or the exact motion.

Start with `world.py`, which says what a world is and makes one. The engine is loaded only by
`physics.py`, `camera.py` and `pushing.py`, a finger and its table. May import all other folders of
tangram_sim but drawing.
"""
