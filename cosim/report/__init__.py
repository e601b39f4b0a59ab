"""Pages that explain a result by themselves: one HTML file, with everything that it shows inside.

Made from a run's folder alone: nothing is simulated here. Start reading at `run_page`; `page` builds pages, of studies too.
"""
