"""What learns and acts: networks, hindsight, replay, learners; and the service's messages.

Start with `setup.py`, what master and workers must agree on, then `learner.py` and `policy.py`. May
import tangram_sim and tangram_core.
"""
