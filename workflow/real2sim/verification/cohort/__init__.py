"""A cohort of synthetic people: who and which files, the sealed gap, and the writing of it all."""
