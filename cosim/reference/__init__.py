"""The reference of scenario keys, written from the code.

The text of a key stands behind its parameter, not here; `extra_docs` holds the exceptions.
"""
