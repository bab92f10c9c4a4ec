"""What a run keeps: its folder, the journal, what of it is there after a kill, and who did what.

Start with `delivery.py` (which batches are new), then `journal.py` and `recovery.py`. `rundir.py`
is the folder and who may write there. `audit.py` and `counters.py` keep what went on. Imports no
other folder of master.
"""
