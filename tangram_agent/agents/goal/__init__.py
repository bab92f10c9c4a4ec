"""DDPG, TD3 and SAC with hindsight, for tasks whose fields are numbers.

Start with `agent.py`: the settings, and the agent that a service asks for its actor and learner.
`learner.py` has the three losses. All that they share with other actor-critics is in
tangram_agent.flat. May import that, tangram_agent.nets, tangram_core and torch.
"""
