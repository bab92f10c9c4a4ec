"""A worker's end of the conversation with the master, and where that is.

Start with `client.py`. Imports no other folder of worker.
"""
