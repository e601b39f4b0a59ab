"""Names of the parts for packages above the assembly, with types: one module for each subject, imported where it is needed.

Names and small functions that call a part. No code of its own that a part could have.
"""
