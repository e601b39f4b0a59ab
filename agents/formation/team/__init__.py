"""Places, shapes, topology, membership, passages."""
