"""Pages that explain a result by themselves: one HTML file, with everything that it shows inside.

Start reading at `cosim.report.run_page`, the page of a run; `page` is what pages are made of, of studies too.
"""
