"""The entry of every command. Start with `commands.py`; it imports our packages late, by name."""
