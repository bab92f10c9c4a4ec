"""What master, workers, tasks and agents share: two interfaces, and how they speak and keep things.

Start with `task.py` and `agent.py`: who implements them has the whole service. `spec.py` says what
an episode is made of. `settings.py` is how settings are declared, `run/process.py` what every
process needs; files are in `store`, addresses in `wire`. May import no other package of ours.
"""
