"""Figures, printed tables and the index page: each reads files and writes files."""
