"""Playing whole episodes, and the session that player and evaluator share.

Start with `player.py` and `rollout.py`. May import worker.talk.
"""
