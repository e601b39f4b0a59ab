"""Vehicles as network namespaces of Linux. Only `interfaces` uses netlink."""
