"""The agent that sees pairs of one token and one piece of the target.

Start with `pairs.py`: the graph of a pair. `planning.py` chooses among pairs, `coverage.py` says
what tokens cover.
"""
