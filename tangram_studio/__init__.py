"""The studio: a web page to play on with the agent. `docs/studio.md` describes its design.

Start with `server.py` and `session.py`. May import tangram_game, worker, tangram_vision and what
these import; only this package serves pages.
"""
