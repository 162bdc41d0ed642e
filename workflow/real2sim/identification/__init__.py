"""Cost, search and what becomes of a fit."""
