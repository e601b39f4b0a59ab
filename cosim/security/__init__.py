"""Certificates of machines: files, authority, X.509. No network: the sessions that use certificates are `cosim.transport`."""
