"""Pushing tokens into place: random pushes of each token, and a critic that says what they lead to.

Start with `agent.py`: the settings. `scenes.py` has what is on tables, and the geometry; `seen.py`
what networks see of it, in the frame of the token that is pushed; `networks.py` the critic, and
what a push does to a token alone, both learned; `choosing.py` which push is best; `actor.py` acts
in workers, `learner.py` learns in the master. May import tangram_agent.base, flat and nets,
tangram_tasks.push, tangram_sim.geometry, tangram_core and torch.
"""
