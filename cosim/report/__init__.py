"""Pages that explain a result by themselves: one HTML file, with everything that it shows inside. Start reading in `page`."""
