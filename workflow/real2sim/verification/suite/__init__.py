"""Synthetic people whose sim-to-real gap has a known, sealed cause: what the diagnosis is scored on."""
