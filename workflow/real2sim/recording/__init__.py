"""From readers' tables to a trial: synchronised, aligned, gaps, jumps, noise; and what a recording is worth."""
