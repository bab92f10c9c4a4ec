"""What every agent is made of: graphs, attention, weights, Adam, compiled updates.

Knows no agent: imports none of tangram_agent.agents.
"""
