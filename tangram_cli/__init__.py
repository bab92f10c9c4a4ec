"""Entry points of all commands. Start with `commands.py`; it imports other packages by name."""
