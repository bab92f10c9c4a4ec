"""Output of a run: console, TensorBoard, /metrics, result.json.

Start with `report.py`, which collects the status that all others show. May import the other folders
of master; none of them imports this one.
"""
