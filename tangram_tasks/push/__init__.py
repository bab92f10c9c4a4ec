"""A finger pushes tokens into place on a table whose friction nobody is told.

`task.py` says what is played and what it is worth, `table.py` is the engine, `env.py` plays.
"""
