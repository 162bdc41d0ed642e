"""Synthetic people written as raw exports by physics of their own; no analysis imports this package."""
