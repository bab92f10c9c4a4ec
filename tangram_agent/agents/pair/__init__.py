"""The agent that sees pairs of one token and one piece of the target.

Start with `pairs.py`: the graph of a pair. `planning.py` chooses among pairs, `covered.py` says
what tokens cover there, `coverage.py` in what is learned from.
"""
