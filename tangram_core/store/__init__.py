"""Files: written atomically, and checked when read. Imports tangram_core only."""
