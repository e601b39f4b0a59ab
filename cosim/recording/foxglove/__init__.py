"""Messages that Foxglove and Lichtblick draw."""
