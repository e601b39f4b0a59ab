"""Pages that explain a result by themselves: one HTML file, with everything that it shows inside.

Start reading at `cosim.report.run`, the page of a run; `page` is what pages are made of, of studies too.
"""
