"""Learning: the trainer, its pace, the budget of the run, and the check for finite weights.

Start with `trainer.py`. `rate_limiter.py` and `lockstep.py` balance learning and playing. Has no
sockets. May import master.record.
"""
