"""The team as a member knows it: shapes, topology, membership, passages. Nothing here commands a vehicle."""
