"""Vehicles as network namespaces of Linux. Only `interfaces` speaks netlink."""
