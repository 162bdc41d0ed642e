"""Which unmodelled effect would have made the paper's numbers? Small cohorts with one cause each, and their ranking."""
