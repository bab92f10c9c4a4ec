"""Communication with workers: sockets, authentication, membership and message handling.

Start with `hub.py`. `sockets.py` has bounded queues. `gate.py` limits connections, `security.py`
checks keys. `admission.py` and `registry.py` decide which workers take part. `giving.py` is
tangram-keys. May import master.record, but not master.learn.
"""
