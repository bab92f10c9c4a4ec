"""What actor-critics share, so that a new one is its networks and its losses.

Start with `agent.py`, which a new agent extends, and `actor_critic.py`, which its learner does;
docs/examples/td3.py is a whole one. `config.py` has the settings that all have. `inputs.py` makes
normalised rows of numbers of a task's fields, `replay.py` keeps episodes and relabels their goals,
`networks.py` has perceptrons, `playing.py` acts in workers. torch is loaded by all but `agent.py`,
`config.py` and `inputs.py`. May import tangram_agent.base and nets, tangram_core and torch.
"""
