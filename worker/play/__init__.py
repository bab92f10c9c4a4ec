"""Playing whole episodes, and the session that player and evaluator share.

Start with `player.py` and `rollout.py`. `looking.py` is the eye, where pictures are observed. May
import worker.talk.
"""
