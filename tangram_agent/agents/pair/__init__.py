"""The agent that sees pairs of one token and one piece of the target.

Start with `pairs.py`: the graph of a pair. `planning.py` chooses among pairs. `covered.py` computes
what tokens cover while playing, `coverage.py` while learning.
"""
