"""The paper's agent: all tokens and the whole target in one graph. Start with `scenes.py`."""
