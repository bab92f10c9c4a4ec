"""The agent that pushes tokens into place: a critic values random pushes of each token.

Start with `agent.py`: the settings. `scenes.py` has tables as tensors, and the geometry. `seen.py`
makes the network inputs, in the frame of the pushed token. `networks.py` has the critics and the
model of a token that is pushed alone, both learned. `choosing.py` finds the best push. `actor.py`
acts in workers, `learner.py` learns in the master. May import tangram_agent.base, flat and nets,
tangram_tasks.push, tangram_sim.geometry, tangram_core and torch.
"""
