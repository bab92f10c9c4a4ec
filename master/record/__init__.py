"""The records of a run: run folder, journal and its recovery, locks, audit log and counters.

Start with `delivery.py` (which batches are new), then `journal.py` and `recovery.py`. `rundir.py`
has the run folder and its lock. `audit.py` and `counters.py` record events. Imports no other folder
of master.
"""
