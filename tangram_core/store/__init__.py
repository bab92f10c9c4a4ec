"""Files: written whole or not at all, and read without trust. Imports tangram_core only."""
