"""Messages between processes: addresses, arrays, encoding. Imports tangram_core only."""
