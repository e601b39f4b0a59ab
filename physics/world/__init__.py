"""What surrounds vehicles: solids, floor, targets, their geometry; the scene at one instant. Nothing here moves a vehicle."""
