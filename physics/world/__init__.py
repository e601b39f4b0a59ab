"""What surrounds vehicles: solids, floor, targets, geometry; the scene at one instant."""
