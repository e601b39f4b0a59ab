"""Certificates of machines: files, authority, X.509."""
