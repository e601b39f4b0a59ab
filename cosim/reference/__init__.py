"""The reference of scenario keys, written from the code."""
