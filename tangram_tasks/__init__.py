"""The tasks that come with the package, each on the interface of `tangram_core.task`.

`place.py`: tokens are moved onto a target whose pieces are seen. `fill.py`: only the outline of the
target is seen. `push/`: a finger pushes tokens. `gym/`: any gymnasium environment with goals.
`goal_env.py` makes a gymnasium environment of any task, and `register.py` has the ids. Start with
`place.py`. May import tangram_core, tangram_sim and tangram_vision.
"""
