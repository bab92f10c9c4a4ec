"""Shared code of master, workers, tasks and agents: interfaces, settings, messages and files.

Start with `task.py` and `agent.py`: a class that implements one of them can use the whole service.
`spec.py` declares the arrays of an episode, `settings.py` the settings. `run/process.py` has what
every process needs, `store` the files, `wire` the messages. May import no other package of ours.
"""
