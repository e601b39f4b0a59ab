"""Questions about runs and scenarios: links, link budgets, coverage, recognition rates, closed forms."""
