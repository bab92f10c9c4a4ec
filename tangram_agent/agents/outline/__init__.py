"""The agent that fills outlines whose pieces are not told.

Start with `filling.py`: what is left of an outline, and what may be laid next. `filler.py` acts,
`learner.py` and `filling_replay.py` learn.
"""
