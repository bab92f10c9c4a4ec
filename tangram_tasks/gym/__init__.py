"""Any gymnasium environment with goals as a task: Fetch, Panda, and a user's own.

Start with `task.py`: settings, rewards and scores. `judge.py` makes one environment, inspects it,
and refuses what hindsight cannot learn. `envs.py` plays several, and is loaded by workers only.
gymnasium is imported when an environment is made. May import only tangram_core of this project.
"""
