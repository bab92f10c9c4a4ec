"""The worker's side of the protocol, and how a worker finds its master.

Start with `client.py`. Imports no other folder of worker.
"""
