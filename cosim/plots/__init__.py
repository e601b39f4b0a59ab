"""Figures of runs, studies, missions and calibrations as PNG and SVG.

Numbers are computed elsewhere (`cosim.metrics`, `cosim.analysis`); no other package but `cosim.reproduction` imports
matplotlib.
"""
