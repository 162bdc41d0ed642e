"""Motion that can be watched: a fitted trial as an MCAP file for Foxglove."""
