"""The tasks that come with the package, each on the interface of `tangram_core.task`.

`place.py`: tokens are moved onto a target that is seen; `fill.py`: onto one of which only the
outline is seen; `push/`: a finger pushes them; `gym/`: any environment of gymnasium with goals.
`goal_env.py` makes one of gymnasium of any of them, and `register.py` has the ids. Start with
`place.py`. May import tangram_core, tangram_sim and tangram_vision.
"""
