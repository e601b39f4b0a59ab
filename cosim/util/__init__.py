"""Helpers without knowledge of simulation: text, files, MessagePack, key expressions, polling, colours."""
