"""Players: whole episodes, and the session code that players and evaluators share.

Start with `player.py` and `rollout.py`. May import worker.talk.
"""
