"""Learning and its pace: what is trained, how much, and what becomes of numbers not finite.

Start with `trainer.py`. `rate_limiter.py` and `lockstep.py` keep learning and playing in step. Has
no sockets. May import master.record.
"""
