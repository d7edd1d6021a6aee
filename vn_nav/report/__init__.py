"""Reports: charts, tables, maps and pages of figures, in HTML and in the terminal."""
