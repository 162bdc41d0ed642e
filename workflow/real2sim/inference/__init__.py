"""Cost, searches, identifiability and noise floor of a fit: what is fitted is not known here."""
