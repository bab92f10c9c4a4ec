"""How exactly, surely and fast pictures and silhouettes are read. Start with `seeing.py`."""
