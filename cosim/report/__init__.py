"""Pages that explain a result by themselves: one HTML file, with everything that it shows inside.

Made from a run's folder alone: nothing is simulated here. Start reading at `cosim.report.run_page`, the page of a run; `page`
is the builder of pages, of studies too.
"""
