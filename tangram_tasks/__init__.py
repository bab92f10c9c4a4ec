"""The tasks that come with the package, each on the interface of `tangram_core.task`.

`place.py`: tokens are moved onto a target that is seen; `fill.py`: onto one of which only the
outline is seen; `gym/`: any environment of gymnasium with goals. Start with `place.py`. May import
tangram_core, tangram_sim and tangram_vision.
"""
