"""Code that all processes of a run share: settings, ends, watchdog, logs, user code, results.

Start with `service.py`. May import the rest of tangram_core.
"""
