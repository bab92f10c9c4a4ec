"""Settings and presets of all commands, composed and checked before anything heavy is loaded.

Start with `commands.py`: each command and the dataclasses that declare its settings. `cli.py` is
the entry point of all commands. The YAML files are presets. May import modules that declare
settings; only files named `cli.py` may import this package.
"""
