"""The studio: a page to play on. `docs/studio.md` tells how it is built.

Start with `server.py` and `session.py`. May import tangram_game, worker, tangram_vision and what
these import; only this package serves pages.
"""
