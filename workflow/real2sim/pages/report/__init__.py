"""The report of a study: one file that holds its figures and tables, needs nothing beside it and is read offline.

A section stands where what it tells of exists; a later stage adds one by adding its function to ``SECTIONS`` in
``page.py``.
"""
