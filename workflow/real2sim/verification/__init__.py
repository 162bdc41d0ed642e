"""Proof that the rest is right: phantom people, suites with sealed causes, scores."""
