"""Learns: one process that takes in episodes, trains and publishes weights; it loads no engine.

Start with `run.py` (who is made or restored) and `loop.py` (what happens, on one screen).
`checkpointer.py` knows all that a checkpoint keeps. `launch.py` with `children.py` and `signals.py`
is tangram-train. Folders, each imports those behind it only: watch, learn | hub, record. May import
tangram_agent, tangram_sim and tangram_core; neither worker nor tangram_vision.
"""
