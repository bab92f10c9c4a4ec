"""How processes reach each other: addresses of sockets. Imports tangram_core only."""
