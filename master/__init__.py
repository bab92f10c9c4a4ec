"""The master: one process that receives episodes, trains and publishes weights.

Start with `run.py` (which objects a run has) and `loop.py` (the main loop, on one screen).
`checkpointer.py` defines what a checkpoint holds. `launch.py`, `children.py` and `signals.py` make
up tangram-train. The folders are watch, learn, hub and record, in layers: watch | learn, hub |
record. A folder imports only from layers after its own. The package may import tangram_agent,
tangram_sim and tangram_core, but no physics engine, worker or tangram_vision.
"""
