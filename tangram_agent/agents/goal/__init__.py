"""DDPG, TD3 and SAC with hindsight, for tasks whose fields are numbers.

Start with `agent.py`: the settings and the agent. `learner.py` has the losses of the three
algorithms. The parts that other actor-critics use, too, are in tangram_agent.flat. May import
tangram_agent.flat, tangram_agent.nets, tangram_core and torch.
"""
