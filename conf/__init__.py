"""Settings and presets: what every command takes, composed and checked before anything is loaded.

Start with `commands.py`: each command and the dataclasses that declare its settings. `cli.py` is
the entry that all commands share. The YAML files beside them are presets. Imports where settings
are declared; read by files named `cli.py` only.
"""
