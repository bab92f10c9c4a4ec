"""The agents: each folder has the modules that only one agent uses."""
