"""Messages that Foxglove and Lichtblick draw. Conversion of values: no file is opened here."""
