"""Protocols of channel layers and media, a vehicle's radio, random numbers per link. No model, no other room of netsim."""
