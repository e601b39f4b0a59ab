"""Protocols of channel layers and media, the vehicle radio, random draws per link."""
