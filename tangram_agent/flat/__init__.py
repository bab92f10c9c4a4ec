"""Shared parts of actor-critic agents: a new agent adds only its networks and its losses.

Start with the base classes: `agent.py` of an agent, `actor_critic.py` of its learner. A complete
example is docs/examples/td3.py. `config.py` has the shared settings. `inputs.py` turns a task's
fields into normalised rows of numbers. `replay.py` keeps episodes and relabels their goals.
`networks.py` has perceptrons, `playing.py` acts in workers. `agent.py`, `config.py` and `inputs.py`
do not import torch. May import tangram_agent.base and nets, tangram_core and torch.
"""
