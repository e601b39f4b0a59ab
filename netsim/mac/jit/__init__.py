"""Compilation of the DCF kernels to machine code."""
