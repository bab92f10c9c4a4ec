"""The agent that fills outlines without knowing the pieces of the target.

Start with `filling.py`: the rest of an outline, and the possible next places of tokens. `filler.py`
acts, `learner.py` and `filling_replay.py` learn.
"""
