"""Any environment of gymnasium with a goal, as a task: Fetch, Panda, and a user's own.

Start with `task.py`: its settings, and what the service asks of it. `judge.py` makes one
environment and finds out what it is; it refuses by name what cannot be learned with hindsight.
`envs.py` plays several, and is loaded by workers only. gymnasium is imported when an environment is
made. May import tangram_core, and nothing else of this project.
"""
