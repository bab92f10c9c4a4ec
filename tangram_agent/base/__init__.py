"""Shared parts of agents of tokens: gradient learning, DDPG with hindsight, acting, settings.

Start with `learning.py`, then `ddpg.py`. Must not import tangram_agent.agents.
"""
