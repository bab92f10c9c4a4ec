"""Talking to workers: sockets, who may connect and who takes part, which message goes where.

Start with `hub.py`. `sockets.py` bounds what is queued, `gate.py` and `security.py` stand at the
door, `admission.py` and `registry.py` say who takes part, `giving.py` makes keys for others. May
import master.record; knows nothing of learning.
"""
