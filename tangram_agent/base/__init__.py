"""What agents of tokens share: learning by gradients, DDPG with hindsight, acting, settings.

Start with `learning.py`, then `ddpg.py`. Knows no agent: imports none of tangram_agent.agents.
"""
