"""Tasks that agents learn, one folder each."""
