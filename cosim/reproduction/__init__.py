"""Published figures and laws, measured again: figures and validation.

No model or parameter that a run needs: only the command line imports this package.
"""
