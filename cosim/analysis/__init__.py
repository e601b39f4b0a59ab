"""Questions about runs and scenarios: links, link budgets, coverage, recognition rates, closed forms.

Answers are values and text: figures belong to `cosim.plots`, and nothing here starts a run.
"""
